"""Model selection keeps the first candidate that no other betters on validation motions; every joint counts alike."""

import jax.numpy as jnp
import numpy as np
from calls import one_line

from dln_jax.data.schema import from_arrays
from dln_jax.data.splits import select
from dln_jax.learning.select import Candidate, FittedModel, grow, select_model, significantly_better
from dln_jax.mechanics.natural import NaturalSystem
from dln_jax.models.model import Model
from dln_jax.types import InputError

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


def candidate(name, *shares):
    """Masses that are wrong by these factors."""
    return Candidate(name, lambda left: FittedModel(MASSES, jnp.asarray(UNIT * shares)))


def refuse(left):
    raise InputError("too large a basis")


def test_a_small_joint_counts_as_much_as_a_large_one():
    found = select_model([candidate("large joint", 1.0, 3.0), candidate("both, nearly", 1.1, 1.1)], TRAIN, VALIDATION)
    assert found.chosen.name == "both, nearly"
    share = (NOISE**2 + (0.1 * UNIT) ** 2 * ARRAYS["qdd"][N:].var(axis=0)) / TAU[:N].var(axis=0)
    assert found.chosen.nmse is not None
    np.testing.assert_allclose(found.chosen.nmse, share, rtol=0.4)


def test_of_equals_the_first_is_chosen_and_what_cannot_be_built_says_why():
    candidates = [
        Candidate("refused", refuse),
        Candidate("absent", lambda left: "no arm"),
        candidate("true", 1, 1),
        candidate("same", 1.001, 1),
    ]
    told = []
    found = select_model(candidates, TRAIN, VALIDATION, report=told.append)
    assert found.chosen.name == "true" and found.ended == "" and list(found.steps) == told
    assert [step.reason for step in found.steps] == ["too large a basis", "no arm", "", ""]


def test_the_search_ends_at_the_noise_and_not_where_that_is_overestimated():
    candidates = [candidate("wrong", 2, 2), candidate("true", 1, 1), candidate("further", 1, 1)]
    found = select_model(candidates, TRAIN, VALIDATION, noise=NOISE)
    assert "true" in found.ended and [step.name for step in found.steps if not step.tried] == ["further"]
    assert not select_model(candidates, TRAIN, VALIDATION, noise=3 * NOISE).ended
    exact = VALIDATION._replace(tau=UNIT * VALIDATION.qdd)
    assert select_model(candidates, TRAIN, exact).ended == "true is exact"


def test_out_of_time_the_first_that_can_be_fitted_is_kept():
    candidates = [Candidate("refused", refuse), candidate("first", 1, 1), candidate("second", 1, 1)]
    found = select_model(candidates, TRAIN, VALIDATION, seconds=1e-9)
    assert found.chosen.name == "first" and found.ended == "time is out"
    assert found.steps[-1].reason == "time is out" and not found.steps[-1].tried


def test_what_cannot_be_fitted_is_refused():
    for tried, seconds, message in [
        (Candidate("refused", refuse), 1.0, "no model could be fitted: refused: too large a basis"),
        (candidate("infinite", np.inf, 1), 1.0, "not finite on validation motions"),
        (candidate("true", 1, 1), 0.0, "seconds is 0.0"),
    ]:
        with one_line(message):
            select_model([tried], TRAIN, VALIDATION, seconds=seconds)


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
        trial, trials = grow(
            range(len(levels)), lambda n, errors=errors: (n, errors[n]), patience=patience, target=target
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
        selection = select_model(
            [candidate(str(size), size, size) for size in sizes],
            TRAIN,
            VALIDATION,
            definite=lambda fitted, indefinite=indefinite: float(fitted.parameters[0]) not in indefinite,
        )
        assert selection.chosen.name == str(chosen), (sizes, indefinite)
