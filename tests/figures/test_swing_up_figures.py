"""Swing-ups are drawn: the places of the rotary pendulum, and files that open."""

import numpy as np
import pytest
from PIL import Image

from dln_jax.figures.swing_ups import rotary_places, write_swing_up_gif
from dln_jax.types import InputError


def test_arm_and_pole_keep_their_lengths_and_point_up():
    q = np.random.default_rng(0).normal(size=(20, 2))
    elbow, tip = rotary_places(q, 0.085, 0.129)
    np.testing.assert_allclose(np.linalg.norm(elbow, axis=1), 0.085)
    np.testing.assert_allclose(np.linalg.norm(tip - elbow, axis=1), 0.129)
    np.testing.assert_allclose(np.sum(elbow * (tip - elbow), axis=1), 0.0, atol=1e-12)
    np.testing.assert_allclose(rotary_places(np.zeros((1, 2)), 0.1, 0.2)[1], [[0.1, 0.0, 0.2]])


@pytest.mark.parametrize("kind", ["cart-pole", "rotary-pendulum"])
def test_a_film_opens(kind, tmp_path):
    t = np.arange(9) / 100
    q, control = np.stack([0.1 * t, np.pi - t], axis=1), np.ones(8)
    write_swing_up_gif(tmp_path / "film.gif", kind, t, q, control, limit=2.0, arm=0.085, pole=0.129)
    with Image.open(tmp_path / "film.gif") as film:
        assert getattr(film, "n_frames", 1) == 3
    with pytest.raises(InputError, match="film of 'dance'"):
        write_swing_up_gif(tmp_path / "film.gif", "dance", t, q, control, limit=2.0, arm=0.1, pole=0.1)
