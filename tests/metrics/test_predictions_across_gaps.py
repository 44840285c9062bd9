"""Valid prediction time of recordings with gaps: by time stamps across them, and not cut to the shortest part."""

import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax import HamiltonianSystem, Model
from dln_jax.data import schema
from dln_jax.metrics.predictions import (
    cut_recordings,
    grid_places,
    predict_measured,
    valid_times,
)

STEP, FITTED, FREQUENCY = 0.05, 12, 3.0


def oscillator(frequency):
    energy = HamiltonianSystem(lambda q, p: 0.5 * jnp.sum(p**2) + 0.5 * frequency**2 * jnp.sum(q**2))
    return Model(init=lambda key: jnp.zeros(1), energies=lambda parameters: energy)


def swings(kept):
    """One recording with the kept samples of 4 s."""
    t = STEP * np.flatnonzero(kept)
    q = np.cos(FREQUENCY * t)[:, None]
    return schema.from_arrays({"t": t, "q": q, "qd": -FREQUENCY * np.sin(FREQUENCY * t)[:, None], "trajectory": 0 * t})


def with_gaps():
    kept = np.ones(81, bool)
    kept[30:34], kept[47:60] = False, False
    return swings(kept)


def test_rounding_of_times_adds_no_step_to_a_gap():
    t = np.array([0.0, 1.0, 2.0, 5.0, 6.0, 7.4])
    for scale in (0.1, 0.7):
        np.testing.assert_array_equal(grid_places(scale * t), [0, 1, 2, 5, 6, 7])


def valid_time(data, frequency):
    """Returns the valid prediction time of an oscillator on one recording."""
    recordings = cut_recordings(data, 200, fitted=FITTED)
    options = {"fitted": FITTED, "substeps": 4, "momenta": True}
    predicted = predict_measured(oscillator(frequency), jnp.zeros(1), recordings, **options)
    return valid_times(recordings, predicted, fitted=FITTED, variance=np.array([0.5]))


def test_predictions_go_on_by_time_stamps_across_gaps():
    """The part after a gap is as short as one sample more than a window; an exact model is right to the end.

    cos(w t) and cos(w' t) part at one time, whether samples before it were measured or not.
    """
    both = with_gaps(), swings(np.ones(81, bool))
    for data in both:
        assert valid_time(data, FREQUENCY) == pytest.approx([4 - (FITTED - 1) * STEP])
    late, exact = (valid_time(data, 1.03 * FREQUENCY)[0] for data in both)
    assert FITTED * STEP < exact <= late < 3.0 and late - exact <= 14 * STEP


def test_starts_lie_on_parts_without_a_gap():
    recordings = cut_recordings(with_gaps(), 30, fitted=FITTED)
    assert np.all(recordings.weight[:, :FITTED] == 1) and len(recordings.t) > 1
    with one_line("no test motion has 41 samples without a gap"):
        cut_recordings(with_gaps(), 200, fitted=40)
