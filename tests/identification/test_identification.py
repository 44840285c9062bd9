"""From data to parameters: exact without noise, physically consistent, honest about what is unknown, in words."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from planar_arm import ARM, FRICTION, LENGTH, motions

from dln_jax.data.splits import select
from dln_jax.identification.consistent import fit_consistent, nearest_body
from dln_jax.identification.equations import (
    base_parameters,
    columns_of,
    compress,
    determinacy,
    flat,
    in_words,
    null_directions,
    regressor_of,
    squares,
    whiten,
)
from dln_jax.identification.identify import (
    base_rows,
    findings,
    identify,
    lost,
    parameter_rows,
    random_states,
    summary,
    text,
)
from dln_jax.identification.residual import fit_residual
from dln_jax.identification.weighted import fit_weighted
from dln_jax.learning.linear import fit_linear, parameters_of
from dln_jax.learning.select import segments
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees.description import serial
from dln_jax.mechanics.trees.inertia import inertial_parameters, pseudo_inertia
from dln_jax.models.residual import make_residual
from dln_jax.models.trees import make_rigid_tree
from tests.calls import one_line

MODEL = make_rigid_tree(ARM, friction=True)
KNOWN = MODEL.init(jax.random.key(0))
ROUGH = KNOWN._replace(inertias=jnp.asarray(0.7 * ARM.inertias))
TRUE = flat(KNOWN._replace(inertias=ARM.inertias, armature=ARM.armature, **FRICTION))
COLUMNS = columns_of(KNOWN)
POSITIVE, INERTIAL = (np.array(COLUMNS.kinds) == kind for kind in ("positive", "inertia"))


def is_consistent(theta, columns):
    """Whether the pseudo-inertia of every body is positive definite; a body with ten zeros counts as consistent."""
    bodies = theta[columns.bodies]
    return [not body.any() or np.linalg.eigvalsh(pseudo_inertia(body))[0] > 0 for body in bodies]


@pytest.fixture(scope="module")
def clean():
    return identify(MODEL, ROUGH, motions(0), consistent=False)


def test_base_parameters_are_those_of_the_textbook():
    equations = compress(regressor_of(MODEL, KNOWN, random_states(ARM.joints, 60, 0)))
    A = equations.triangles.reshape(-1, 29)[:, :-1]
    base = base_parameters(A, COLUMNS)
    assert base.words == (
        *("h_x_1 + 0.5 m_2", "h_y_1", "I_zz_1 + 0.25 m_2 + armature_1", "h_x_2", "h_y_2", "I_zz_2", "armature_2"),
        *(f"{law}_{joint}" for law in ("viscous", "coulomb", "offset") for joint in (1, 2)),
    )
    np.testing.assert_allclose(base.combinations[2][COLUMNS.names.index("m_2")], LENGTH**2, rtol=1e-12)
    # Forces depend on them alone.
    np.testing.assert_allclose(A[:, list(base.independent)] @ base.combinations, A, atol=1e-9 * abs(A).max())
    directions = null_directions(A)
    assert len(directions) == len(COLUMNS.names) - 13
    kinds = dict(zip(COLUMNS.names, determinacy(A), strict=True))
    together = {name for name, kind in kinds.items() if kind == "in combination"}
    assert together == {"h_x_1", "I_zz_1", "m_2", "armature_1"}
    assert kinds["m_1"] == kinds["I_xx_2"] == kinds["h_z_2"] == "not at all"
    assert kinds["h_y_1"] == kinds["I_zz_2"] == kinds["armature_2"] == kinds["coulomb_1"] == "alone"
    assert in_words(np.array([-0.5, 1.0, 0.0, -1.0]), ("a", "b", "c", "d"), 1) == "b - 0.5 a - d"


def test_clean_data_give_the_base_parameters_and_torques_of_other_motions(clean):
    combinations = clean.base.combinations
    np.testing.assert_allclose(combinations @ clean.fit.theta, combinations @ TRUE, atol=1e-10)
    assert len(combinations) == clean.fit.rank == 13
    known = np.array(clean.structure) == "not at all"
    np.testing.assert_array_equal(clean.theta[known], clean.known[known])
    assert clean.seen == clean.structure and not lost(clean)
    test = motions(1)
    motion = dynamics(MODEL.energies(parameters_of(clean.theta, ROUGH)))
    predicted = jax.jit(jax.vmap(motion.inverse_dynamics))(test.q, test.qd, test.qdd)
    np.testing.assert_allclose(predicted, test.tau, atol=1e-9)


def test_noise_is_estimated_and_bodies_exist():
    data = motions(2, noise=0.1, trajectories=4)
    result = identify(MODEL, ROUGH, data)
    np.testing.assert_allclose(result.fit.noise, 0.1, rtol=0.1)
    assert result.consistent is not None and all(is_consistent(result.theta, result.columns))
    for row, value in zip(base_rows(result), result.base.combinations @ TRUE, strict=True):
        assert abs(row["value"] - value) < 5 * row["standard_error"]
    robust = identify(MODEL, ROUGH, data, robust=True, consistent=False)
    np.testing.assert_allclose(robust.fit.noise, 0.1, rtol=0.15)


def test_a_joint_that_never_moves_is_said():
    """The other's parameters are result; what only its motion shows stays as the file has it."""
    data = motions(3, noise=0.01, still=(1,))
    result = identify(MODEL, ROUGH, data)
    assert findings(result, data, ARM.names)[0].startswith("elbow: does not move, ")
    assert {"armature_2", "viscous_2"} <= {*lost(result)}
    moved, unseen = (COLUMNS.names.index(f"viscous_{joint}") for joint in (1, 2))
    assert result.seen[moved] == "alone" and abs(result.fit.theta[moved] - FRICTION["viscous"][0]) < 0.05
    assert result.fit.theta[unseen] == result.known[unseen]
    assert np.isinf(result.fit.standard_errors(np.eye(len(TRUE)))[unseen])


def test_words_and_rows(clean):
    page = text(clean)
    for words in ("h_x_1 + 0.5 m_2", "motions determine 11 alone, 4 in combination, 13 not at all: 13 base", "±"):
        assert words in page
    rows = {row["name"]: row for row in parameter_rows(clean)}
    assert rows["m_1"]["data"] == "not at all" and rows["m_1"]["standard_error"] is None
    assert rows["coulomb_2"]["standard_error"] < 1e-6 and "13 combinations" in summary(clean)[1]


@pytest.mark.slow
def test_links_without_mass_stay_so():
    """As between two joints of one MJCF body."""
    body = inertial_parameters(1.0, [0.1, 0.2, 0.3], np.diag([0.02, 0.03, 0.04]))
    tree = serial(np.stack([np.eye(3)] * 2), np.zeros((2, 3)), [np.zeros(10), body], axes=[[1, 0, 0], [0, 1, 0]])
    model = make_rigid_tree(tree)
    data = motions(0, noise=1e-3, friction=False, tree=tree)
    result = identify(model, model.init(jax.random.key(0)), data)
    assert not result.theta[:10].any() and all(is_consistent(result.theta, result.columns))
    np.testing.assert_allclose(result.theta[10], 1.0, rtol=0.3)


@pytest.fixture(scope="module")
def noisy():
    """Noisy equations of an arm that is known roughly, what is known, and the fit."""
    equations = compress(regressor_of(MODEL, ROUGH, motions(0, noise=0.2, trajectories=3)))
    return equations, flat(ROUGH), fit_weighted(equations, flat(ROUGH))


def test_consistent_bodies_exist_and_cost_little(noisy):
    equations, known, fit = noisy
    result = fit_consistent(whiten(equations, fit.noise), COLUMNS, known)
    assert result.converged and all(is_consistent(result.theta, COLUMNS)) and not all(is_consistent(fit.theta, COLUMNS))
    assert (result.theta[POSITIVE] > 0).all()
    # Least squares is the least there is; a body that exists explains as much but for some standard errors.
    assert (squares(equations, result.theta) <= squares(equations, fit.theta) * 1.03).all()
    # Friction, which data show alone, is what it was.
    own = np.array([name.split("_")[0] in FRICTION for name in COLUMNS.names])
    errors = fit.standard_errors(np.eye(len(known)))
    assert (abs(result.theta - TRUE)[own] < 5 * errors[own] + 0.01).all()


def test_regularisation_keeps_what_is_known(noisy):
    """A hundred million measurements' worth of trust leave the bodies where they were, and none lets them go."""
    equations, known, fit = noisy
    triangle = whiten(equations, fit.noise)
    tight, *loose = (fit_consistent(triangle, COLUMNS, known, regularisation=strength) for strength in (1e8, 1.0, 1e-3))
    np.testing.assert_allclose(tight.theta[INERTIAL], known[INERTIAL], rtol=1e-2, atol=1e-3)
    some, most = (result.divergence.sum() for result in loose)
    assert tight.divergence.sum() < 1e-3 < some < most


def sum_of(theta, triangle, known):
    """F by its definition, with unit regularisation, as a function of logarithms of the coefficients."""
    total = np.sum((triangle @ np.append(theta, -1.0)) ** 2)
    for body, other in zip(theta[INERTIAL].reshape(-1, 10), known[INERTIAL].reshape(-1, 10), strict=True):
        M = np.linalg.solve(pseudo_inertia(other), pseudo_inertia(body))
        total += np.trace(M) - np.linalg.slogdet(M)[1] - 4
    return total + 0.5 * np.sum(np.log(theta[POSITIVE] / known[POSITIVE]) ** 2)


@pytest.mark.parametrize("spoiled", [False, True])
def test_no_direction_decreases_the_sum(noisy, spoiled):
    """Also with a torque turned round, where bodies lie at the edge of those that exist."""
    equations, known, fit = noisy
    triangle = whiten(equations, fit.noise)
    if spoiled:
        triangle = np.linalg.qr(np.vstack([triangle[:, :-1].T, -triangle[:, -1] + triangle[:, 0]]).T, mode="r")
    known = np.where(POSITIVE & (known == 0), 0.1, known)
    result = fit_consistent(triangle, COLUMNS, known)
    assert result.converged and result.iterations < 200 and all(is_consistent(result.theta, COLUMNS))
    least = sum_of(result.theta, triangle, known)
    for size in (1e-2, 1e-4):
        # Relative steps of each parameter; those that leave the consistent bodies have no sum.
        steps = result.theta * np.exp(size * np.random.default_rng(0).normal(size=(20, len(known))))
        for theta in steps:
            assert not all(is_consistent(theta, COLUMNS)) or sum_of(theta, triangle, known) >= least * (1 - 1e-9)
    short = fit_consistent(triangle, COLUMNS, known, iterations=3)
    assert not short.converged and short.iterations == 3


def test_the_nearest_body():
    body = inertial_parameters(2.0, [0.1, -0.2, 0.3], np.diag([0.03, 0.04, 0.05]))
    np.testing.assert_array_equal(nearest_body(body), body)
    hollow = np.where(np.arange(10) == 4, -1.0, body)
    assert np.linalg.eigvalsh(pseudo_inertia(nearest_body(hollow)))[0] > 0


def sprung(stiffness):
    """Six motions, of an arm whose second joint has a spring that is not of the tree."""
    data = motions(0, noise=0.01, trajectories=6, samples=60, friction=False)
    torque = -2 * stiffness * np.sin(2 * data.q[:, 1])
    return data._replace(tau=data.tau + np.stack([0 * torque, torque], axis=1))


@pytest.mark.parametrize("stiffness", [4.0, 0.0])
def test_a_network_is_added_only_where_it_helps(stiffness):
    train, validation, test = (select(sprung(stiffness), which) for which in ([0, 1, 2], [3, 4], [5]))
    identified = fit_linear(MODEL, train, negligible=1e-12).parameters
    candidates = ((("potential",), 6),)
    settings = {"candidates": candidates, "iterations": 30}
    model, parameters, chosen = fit_residual(MODEL, identified, ARM.needs, train, validation, **settings)

    def error(model, parameters):
        tau = jax.jit(jax.vmap(dynamics(model.energies(parameters)).inverse_dynamics))(test.q, test.qd, test.qdd)
        return float(np.mean((tau - test.tau) ** 2))

    if stiffness:
        assert error(model, parameters) < 0.2 * error(MODEL, identified)
    else:
        assert model is MODEL and not chosen


def test_segments_stay_within_trajectories():
    data = sprung(0.0)
    pairs = {*zip(segments(data, 1.0), data.trajectory, strict=True)}
    assert len(pairs) == len({number for number, _ in pairs}) == 6 * 7  # the last sample, at 6 s, begins one of its own


def test_mistakes_are_named(noisy):
    equations, known, fit = noisy
    data = motions(0, samples=30)
    for call, words in (
        (lambda: identify(MODEL, ROUGH, data, joints=("revolute",) * 3), "the data have 2 joints, the robot 3"),
        (lambda: identify(MODEL, ROUGH, data._replace(estimated=("tau",))), "have no tau"),
        (lambda: identify(MODEL, ROUGH, data, robust=True, noise=[1.0, 1.0]), "leave out noise or robust"),
        (lambda: fit_consistent(whiten(equations, fit.noise), COLUMNS, known, regularisation=0.0), "regularisation"),
        (lambda: nearest_body(np.zeros(10)), "no mass"),
        (lambda: make_residual(ARM.needs, terms=()), "terms are"),
        (lambda: make_residual(ARM.needs, torque_scale=0.0), "torque_scale"),
    ):
        with one_line(words):
            call()
