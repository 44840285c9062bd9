"""Model selection keeps the first candidate that no other betters on validation motions; every joint counts alike."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
from calls import one_line

from dln_jax.data.schema import from_arrays
from dln_jax.data.splits import select
from dln_jax.learning.fits.automatic import compare
from dln_jax.learning.select import select as choose
from dln_jax.learning.select import significantly_better
from dln_jax.mechanics.natural import NaturalSystem
from dln_jax.models.model import Model

RANDOM = np.random.default_rng(0)
N = 120
ARRAYS = {key: RANDOM.normal(size=(2 * N, 2)) for key in ("q", "qd", "qdd")}
UNIT = np.array([1.0, 1e-3])
"""Masses of a large joint and a small one: forces are masses times accelerations."""
NOISE = 0.1 * UNIT
TAU = UNIT * ARRAYS["qdd"] + NOISE * RANDOM.normal(size=(2 * N, 2))
TIMES = {"t": np.tile(0.1 * np.arange(N), 2), "trajectory": np.repeat([0, 1], N)}
TRAIN, VALIDATION = (select(from_arrays({**ARRAYS, **TIMES, "tau": TAU}), [index]) for index in range(2))
MASSES = Model(lambda key: jnp.ones(2), lambda masses: NaturalSystem(lambda q: jnp.diag(jnp.sqrt(masses))))


def candidate(*shares):
    """Masses that are wrong by these factors."""
    return lambda: SimpleNamespace(model=MASSES, parameters=jnp.asarray(UNIT * shares))


def compared(validation=VALIDATION, **more):
    """The kept candidate, what is told of each, and why the comparison ended."""
    usual = {"noise": np.nan, "until": np.inf, "definite": lambda model: True}
    candidates, more = more.pop("candidates"), {**usual, "say": lambda line: None, **more}
    kept, rows, ended = compare(candidates, TRAIN, validation, **more)
    return kept.candidate, rows, ended


def test_a_small_joint_counts_as_much_as_a_large_one():
    candidates = {"large joint": candidate(1.0, 3.0), "both, nearly": candidate(1.1, 1.1)}
    kept, rows, _ = compared(candidates=candidates)
    assert kept == "both, nearly"
    share = (NOISE**2 + (0.1 * UNIT) ** 2 * ARRAYS["qdd"][N:].var(axis=0)) / TAU[:N].var(axis=0)
    np.testing.assert_allclose(rows[1]["joints"], share, rtol=0.4)


def test_of_equals_the_first_is_chosen_and_what_cannot_be_built_says_why():
    told = []
    candidates = {"absent": lambda: "no arm", "true": candidate(1, 1), "same": candidate(1.001, 1)}
    kept, rows, ended = compared(candidates=candidates, say=told.append)
    assert kept == "true" and ended == "" and [line.partition(":")[0] for line in told] == list(candidates)
    assert rows[0]["reason"] == "no arm" and "reason" not in rows[1]


def test_the_search_ends_at_the_noise_and_not_where_that_is_overestimated():
    candidates = {"wrong": candidate(2, 2), "true": candidate(1, 1), "further": candidate(1, 1)}
    _, rows, ended = compared(candidates=candidates, noise=NOISE)
    assert "true" in ended and [row["name"] for row in rows] == ["wrong", "true"]
    assert not compared(candidates=candidates, noise=3 * NOISE)[2]
    assert compared(VALIDATION._replace(tau=UNIT * VALIDATION.qdd), candidates=candidates)[2] == "true is exact"


def test_out_of_time_the_first_that_can_be_fitted_is_kept():
    candidates = {"refused": lambda: "too large", "first": candidate(1, 1), "second": candidate(1, 1)}
    kept, rows, ended = compared(candidates=candidates, until=0.0)
    assert kept == "first" and ended == "time is up after 0 s; second not tried" and len(rows) == 2


def test_what_cannot_be_fitted_is_refused():
    for tried, message in [
        (lambda: "too large a basis", "no model could be fitted: alone: too large a basis"),
        (candidate(np.inf, 1), "not finite on validation motions"),
    ]:
        with one_line(message):
            compared(candidates={"alone": tried})


SHARED_NOISE = np.random.default_rng(1).normal(size=400) ** 2
OWN = np.random.default_rng(2).uniform(0.5, 1.5, 400)


def errors_of(level):
    """Squared errors of a model at a level of its own above the noise that all models share."""
    return SHARED_NOISE + level * OWN


def test_better_means_beyond_the_paired_standard_error():
    assert significantly_better(SHARED_NOISE, errors_of(0.1))
    assert SHARED_NOISE.std() / 20 > 0.05  # the noise's own standard error is half of that difference
    assert not significantly_better(errors_of(0.1), SHARED_NOISE)
    wobble = RANDOM.permutation(np.repeat([-1.0, 1.0], 200))
    assert not significantly_better(SHARED_NOISE + wobble - 1e-3, SHARED_NOISE)
    infinite = errors_of(np.nan)
    assert significantly_better(SHARED_NOISE, infinite) and not significantly_better(infinite, SHARED_NOISE)


def test_the_smallest_sufficient_candidate_is_chosen():
    for levels, patience, target, chosen, trained in [
        ((9.0, 1.0, 0.0, 0.0, 0.0), 2, None, 2, 5),
        ((9.0, 1.0, 0.0, 0.0, 0.0), 1, None, 2, 4),
        ((9.0, 1.0, 5.0, 0.0, 0.0), 2, None, 3, 5),  # one that got stuck does not end the growing
        ((np.nan, 1.0, 1.0, 1.0), 2, None, 1, 4),
        ((9.0, 1.0, 0.0), 2, 2.5, 1, 2),
    ]:
        errors = [errors_of(level) for level in levels]
        trial, trials = choose(
            range(len(levels)),
            lambda n, errors=errors: (n, errors[n]),
            patience=patience,
            stop=lambda trial, target=target: target is not None and trial.validation <= target,
        )
        assert trial.candidate == trial.outcome == chosen and len(trials) == trained, levels


def test_models_with_indefinite_masses_come_last_among_those_that_explain_the_torques():
    """The last row: no candidate explains every joint to 5 %, and only the second has definite mass matrices."""
    for sizes, indefinite, chosen in [
        ((3.0, 1.1, 1.0), (), 1.0),
        ((3.0, 1.1, 1.0), (1.0,), 1.1),
        ((3.0, 1.1, 1.0), (1.0, 1.1), 1.0),  # the rough one explains too little to come first
        ((1.3, 1.4), (1.3,), 1.4),
    ]:
        kept, *_ = compared(
            candidates={str(size): candidate(size, size) for size in sizes},
            definite=lambda fitted, indefinite=indefinite: float(fitted.parameters[0]) not in indefinite,
        )
        assert kept == str(chosen), (sizes, indefinite)
