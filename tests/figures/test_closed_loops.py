"""Figures of closed loops show the limits, the failures and the whole run; films move in real time."""

import numpy as np
import pytest
from calls import one_line
from numpy.testing import assert_array_equal
from PIL import Image

from dln_jax.control.closed_loop import ClosedLoopRun
from dln_jax.figures.closed_loops import (
    cart_pole_drawing,
    closed_loop_traces,
    rotary_pendulum_drawing,
    write_closed_loop_gif,
)
from dln_jax.figures.torques import friction_curves

T = np.linspace(0, 1, 51)
Q = np.stack([0.1 * np.sin(3 * T), np.pi * (1 - T)], axis=1)
U = 2.0 * np.sign(np.sin(9 * T))


def test_traces_show_every_coordinate_and_the_limits():
    x = np.tile(np.concatenate([Q, 0 * Q], axis=1), (3, 1, 1))
    runs = ClosedLoopRun(T, x, np.tile(U[:-1, None], (3, 1, 1)), x[:, :-1])
    joules = 10.0 * (-1.0) ** np.arange(51) * np.ones((3, 1))  # leaps are no turns
    options = {"limits": (-2.0, np.inf), "energy": joules, "goal_energy": 0.1}
    figure = closed_loop_traces(runs, ("prismatic", "revolute"), **options)
    cart, pole, control, energy = figure.axes
    assert len(cart.lines) == 4 and len(energy.lines) == 4
    assert [float(line.get_ydata()[0]) for line in control.lines[1:]] == [-2.0]
    assert np.abs(pole.lines[0].get_ydata()).max() <= np.pi
    assert np.isfinite(energy.lines[0].get_ydata()).all()
    with one_line(r"expected \[K, T, 2 d\]"):
        closed_loop_traces(runs, ("revolute",))


@pytest.mark.parametrize("outcome", ["true", "false"])
def test_a_film_is_as_long_as_its_run_and_an_mp4_if_ffmpeg_succeeds(outcome, tmp_path, monkeypatch):
    path = tmp_path / "film.gif"
    (tmp_path / "ffmpeg").symlink_to(f"/usr/bin/{outcome}")
    monkeypatch.setenv("PATH", str(tmp_path))
    for drawing in (cart_pole_drawing(0.3), rotary_pendulum_drawing(0.1, 0.13)):
        write_closed_loop_gif(path, drawing, T, Q, U, limits=(-2.0, 2.0), frames_per_second=4.0)
        with Image.open(path) as film:
            assert getattr(film, "n_frames", 1) == 4 and film.info["duration"] == 250
        assert path.with_suffix(".mp4").exists() == (outcome == "true")
    with one_line("all finite"):
        write_closed_loop_gif(path, drawing, T, Q * np.nan, U)


def test_each_joint_has_its_friction_curves_in_the_order_of_its_rates():
    rates = np.random.default_rng(0).normal(size=(50, 5))
    figure = friction_curves({"fit": (rates, np.tanh(rates)), "plant": (rates, rates)}, measured=(rates, rates**2))
    shown = [axis for axis in figure.axes if axis.get_visible()]
    assert len(shown) == 5 and shown[4].get_title() == "joint 5"
    points, fit, plant = shown[4].lines[:3]
    assert_array_equal(points.get_ydata(), rates[:, 4] ** 2)
    assert_array_equal(fit.get_xdata(), np.sort(rates[:, 4]))
    assert_array_equal(plant.get_ydata(), np.sort(rates[:, 4]))
