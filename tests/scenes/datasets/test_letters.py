"""Letters: smooth in time, inside the arm's workspace, the same everywhere."""

import jax
import jax.numpy as jnp
import jaxtyping
import matplotlib
import numpy as np
import pytest
from calls import one_line

from dln_jax.scenes.datasets.letters import LETTERS, letter_path, outline


def motion(position, time):
    """Position, velocity and acceleration at one time."""

    def velocity(at):
        return jax.jvp(position, (at,), (jnp.ones_like(at),))[1]

    return position(time), *jax.jvp(velocity, (time,), (jnp.ones_like(time),))


# `position` is an argument: letters with equally many strokes share one compilation.
compiled_motions = jax.jit(jax.vmap(motion, in_axes=(None, 0)))
SAMPLES = 1201


def motions(path, times):
    """Position, velocity and acceleration [times, 2]; padded to one length: one compilation."""
    padded = np.pad(np.asarray(times), (0, SAMPLES - len(times)), mode="edge")
    return tuple(np.asarray(values)[: len(times)] for values in compiled_motions(path[1], padded))


@pytest.fixture(scope="module", params=["am", pytest.param("the others", marks=pytest.mark.slow)])
def letters(request):
    """Letters with their motions at SAMPLES times."""

    def drawn(character):
        path = letter_path(character)
        times = np.linspace(0.0, path[0], SAMPLES)
        return character, path, times, *motions(path, times)

    return [drawn(each) for each in (request.param if request.param == "am" else sorted(set(LETTERS) - set("am")))]


def junctions(path):
    """Times when strokes begin, and the end: contours are strokes 0, 2, 4, ..."""
    starts = np.asarray(path[1].args[1]) * path[0]
    return np.append(starts, path[0])


def test_derivatives_agree_with_finite_differences(letters):
    for character, path, times, _, velocity, acceleration in letters:
        errors = []
        for step in (4e-3, 1e-3):
            inner = times[20:-20:7]
            before, here, after = (motions(path, inner + k * step)[0] for k in (-1, 0, 1))
            slope = (after - before) / (2.0 * step) - velocity[20:-20:7]
            bend = (after - 2.0 * here + before) / step**2 - acceleration[20:-20:7]
            errors.append((np.abs(slope).max(), np.abs(bend).max()))
        coarse, fine = errors
        # Second order in both; where strokes and ramps join the jerk has kinks, hence 8 and not 16.
        assert fine[0] < coarse[0] / 8.0 and fine[0] < 2e-4, character
        assert fine[1] < coarse[1] / 8.0 and fine[1] < 5e-3, character


def test_rests_at_every_junction_and_outside_and_closes_contours(letters):
    for character, path, *_ in letters:
        corners = junctions(path)
        position, velocity, acceleration = motions(path, np.append(corners, [-0.5, path[0] + 0.5]))
        np.testing.assert_allclose(velocity, 0.0, atol=1e-12)
        np.testing.assert_allclose(acceleration, 0.0, atol=1e-9)
        np.testing.assert_allclose(position[-2], position[0], atol=1e-12)
        np.testing.assert_allclose(position[-1], position[-3], atol=1e-12)
        assert len(corners) == 2 * len(outline(character))
        np.testing.assert_allclose(position[0:-2:2], position[1:-2:2], rtol=0.0, atol=1e-12)


def test_stays_in_the_workspace(letters):
    for character, path, times, position, velocity, acceleration in letters:
        assert np.all(position > [0.4, -0.15]) and np.all(position < [1.7, 1.2]), character
        reach = np.linalg.norm(position, axis=1)
        assert reach.min() > 0.25 and reach.max() < 1.85, character
        assert 3.0 <= path[0] <= 8.0, character
        speed = np.linalg.norm(velocity, axis=1)
        assert 0.5 < speed.max() < 2.0, character
        assert np.trapezoid(speed, times) / path[0] == pytest.approx(0.53, rel=1e-4), character
        assert 2.0 < np.linalg.norm(acceleration, axis=1).max() < 7.0, character


def test_scaling_of_time_and_place():
    slow, fast = letter_path("e"), letter_path("e", mean_speed=1.06, centre=(2.05, -0.55))
    assert fast[0] == pytest.approx(slow[0] / 2.0)
    relative = np.linspace(0.0, 1.0, 101)
    there, here = (motions(path, relative * path[0])[0] for path in (fast, slow))
    np.testing.assert_allclose(there, here + np.array([1.0, -1.0]), atol=1e-9)


def test_is_the_same_on_every_machine():
    """Values written down once: neither platform nor version of matplotlib may move them."""
    path = letter_path("a")
    assert path[0] == pytest.approx(6.067241610475574, rel=1e-9)
    position = motions(path, np.array([0.3, 0.8]) * path[0])[0]
    expected = [[0.9514085089000823, 0.4810760119471467], [1.1778256461233998, 0.23034506333699223]]
    np.testing.assert_allclose(position, expected, rtol=0.0, atol=1e-9)


def test_settings_change_nothing():
    settings = {
        "font.family": ["cursive", "monospace"],
        "text.usetex": True,
        "text.hinting": "force_autohint",
    }
    for character in "g$\\%":
        before = outline(character)
        with matplotlib.rc_context(settings):
            after = outline(character)
        for first, second in zip(before, after, strict=True):
            np.testing.assert_array_equal(first, second)


def test_refuses_what_has_no_outline_and_wrong_numbers(monkeypatch):
    # Users run without the type checker, which would refuse a number before the library does.
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    for character, got in [
        (" ", "' ', an empty glyph"),
        ("ab", "'ab', a str"),
        ("\n", "not in the font"),
        (3, "3, a int"),
    ]:
        with one_line(f"{got}.*expected one printable character"):
            letter_path(character)
    for wrong in ({"height": 0.0}, {"mean_speed": -1.0}, {"smoothing": np.nan}, {"centre": (0.0, np.inf)}):
        with one_line(f"{next(iter(wrong))} is .*expected"):
            letter_path("a", **wrong)
