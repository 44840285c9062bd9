"""Figures of closed loops show the limits, the failures and the whole run; films move in real time."""

import numpy as np
import pytest
from PIL import Image

from dln_jax.control import ClosedLoopRun
from dln_jax.figures import (
    cart_pole_drawing,
    closed_loop_traces,
    phase_portrait,
    rotary_pendulum_drawing,
    write_closed_loop_gif,
)
from dln_jax.types import InputError

T = np.linspace(0, 1, 51)
Q = np.stack([0.1 * np.sin(3 * T), np.pi * (1 - T)], axis=1)
X = np.tile(np.concatenate([Q, 0 * Q], axis=1), (3, 1, 1))
U = 2.0 * np.sign(np.sin(9 * T[:-1]))[None, :, None].repeat(3, axis=0)


def test_traces_show_every_coordinate_and_the_limits():
    runs = ClosedLoopRun(T, X, U, X[:, :-1])
    joules = 10.0 * (-1.0) ** np.arange(51) * np.ones((3, 1))  # leaps are no turns
    options = {"limits": (-2.0, np.inf), "energy": joules, "goal_energy": 0.1}
    figure = closed_loop_traces(runs, ("prismatic", "revolute"), **options)
    cart, pole, control, energy = figure.axes
    assert len(cart.lines) == 4 and len(energy.lines) == 4
    assert [float(line.get_ydata()[0]) for line in control.lines[1:]] == [-2.0]
    assert np.abs(pole.lines[0].get_ydata()).max() <= np.pi
    assert np.isfinite(energy.lines[0].get_ydata()).all()
    figure.draw_without_rendering()
    with pytest.raises(InputError, match=r"expected \[K, T, 2 d\]"):
        closed_loop_traces(runs, ("revolute",))


def test_the_portrait_goes_round_and_fills_what_is_caught():
    angles = np.linspace(0, 4 * np.pi, 200)[None]
    figure = phase_portrait(angles, np.cos(angles), caught=(np.diag([4.0, 1.0]), 1.0))
    (axis,) = figure.axes
    drawn = np.asarray(axis.lines[0].get_xdata())
    assert np.isnan(drawn).sum() == 2 and np.nanmax(np.abs(drawn)) <= np.pi
    np.testing.assert_allclose(axis.patches[0].get_xy().max(axis=0), [0.5, 1.0], rtol=1e-2)


@pytest.mark.parametrize("drawing", [cart_pole_drawing(0.3), rotary_pendulum_drawing(0.1, 0.13)])
def test_a_film_is_as_long_as_its_run(drawing, tmp_path):
    path = tmp_path / "film.gif"
    u = np.append(U[0, :, 0], 0.0)
    write_closed_loop_gif(path, drawing, T, Q, u, limits=(-2.0, 2.0), frames_per_second=4.0)
    with Image.open(path) as film:
        assert getattr(film, "n_frames", 1) == 4 and film.info["duration"] == 250
    with pytest.raises(InputError, match="all finite"):
        write_closed_loop_gif(path, drawing, T, Q * np.nan, u)
