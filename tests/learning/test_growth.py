"""Growing a model only as far as the validation samples say."""

import numpy as np
import pytest

from dln_jax.learning.model_selection import grow, significantly_better

RANDOM = np.random.default_rng(0)
NOISE = RANDOM.normal(size=400) ** 2


def errors_of(level):
    """Squared errors of a model at a level of its own above the noise that all models share."""
    return NOISE + level * RANDOM.uniform(0.5, 1.5, 400)


def test_better_means_beyond_the_paired_standard_error():
    assert significantly_better(NOISE, errors_of(0.1))  # although 0.1 is less than the noise's own standard error
    assert NOISE.std() / 20 > 0.05
    assert not significantly_better(errors_of(0.1), NOISE)
    wobble = RANDOM.permutation(np.repeat([-1.0, 1.0], 200))
    assert not significantly_better(NOISE + wobble - 1e-3, NOISE)
    assert significantly_better(NOISE, np.full(400, np.nan)) and not significantly_better(np.full(400, np.nan), NOISE)


@pytest.mark.parametrize(
    ("levels", "patience", "target", "chosen", "trained"),
    [
        ((9.0, 1.0, 0.0, 0.0, 0.0), 2, None, 2, 5),
        ((9.0, 1.0, 0.0, 0.0, 0.0), 1, None, 2, 4),
        ((9.0, 1.0, 5.0, 0.0, 0.0), 2, None, 3, 5),  # one that got stuck does not end the growing
        ((np.nan, 1.0, 1.0, 1.0), 2, None, 1, 4),
        ((9.0, 1.0, 0.0), 2, 2.5, 1, 2),
        ((9.0,), 2, None, 0, 1),
    ],
)
def test_the_smallest_sufficient_candidate_is_chosen(levels, patience, target, chosen, trained):
    trial, trials = grow(range(len(levels)), lambda n: (n, errors_of(levels[n])), patience=patience, target=target)
    assert trial.candidate == trial.outcome == chosen and len(trials) == trained
