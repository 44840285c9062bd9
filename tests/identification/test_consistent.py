"""The parametrisation reaches all physically consistent bodies and no other; it costs little where the truth is one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from planar_arm import ARM, FRICTION, motions

from dln_jax.identification.consistent import fit_consistent, is_consistent, nearest_body
from dln_jax.identification.equations import columns_of, compressed, flat, regressor_of, squares, weighted
from dln_jax.identification.weighted import fit_weighted
from dln_jax.mechanics.trees import body_of_pseudo_inertia, inertial_parameters, moved, pseudo_inertia
from dln_jax.models.rigid_tree import make_rigid_tree
from dln_jax.types import InputError

BODY = inertial_parameters(2.0, [0.1, -0.2, 0.3], np.diag([0.03, 0.04, 0.05]))


@pytest.fixture(scope="module")
def noisy():
    """An arm known roughly, and noisy equations of it."""
    model = make_rigid_tree(ARM, friction=True)
    known = model.init(jax.random.key(0))._replace(inertias=jnp.asarray(0.6 * ARM.inertias))
    equations = compressed(regressor_of(model, known, motions(0, noise=0.2, trajectories=3)))
    fit = fit_weighted(equations, flat(known))
    return equations, columns_of(known), flat(known), fit


def test_a_pseudo_inertia_is_a_body():
    np.testing.assert_allclose(body_of_pseudo_inertia(pseudo_inertia(BODY)), BODY, rtol=1e-12)
    np.testing.assert_allclose(body_of_pseudo_inertia(jnp.asarray(pseudo_inertia(BODY))), BODY, rtol=1e-12)


def test_the_nearest_body():
    np.testing.assert_array_equal(nearest_body(BODY), BODY)
    hollow = BODY.copy()
    hollow[4] = -1.0
    assert np.linalg.eigvalsh(pseudo_inertia(nearest_body(hollow)))[0] > 0
    with pytest.raises(InputError, match="no mass"):
        nearest_body(np.zeros(10))


def test_all_exist_and_it_costs_little(noisy):
    equations, columns, known, fit = noisy
    result = fit_consistent(weighted(equations, fit.noise), columns, known)
    assert all(is_consistent(result.theta, columns)) and result.converged
    positive = np.array(columns.kinds) == "positive"
    assert (result.theta[positive] > 0).all()
    # Least squares is the least there is; a body that exists explains as much but for some standard errors.
    free, bound = squares(equations, fit.theta), squares(equations, result.theta)
    assert (bound <= free * 1.03).all()
    # Friction, which data show alone, is what it was.
    errors = fit.standard_errors(np.eye(len(known)))
    for law, values in FRICTION.items():
        for joint, value in enumerate(values):
            k = columns.names.index(f"{law}_{joint + 1}")
            assert abs(result.theta[k] - value) < 5 * errors[k] + 0.01
    assert not all(is_consistent(fit.theta, columns))


def test_regularisation_keeps_what_is_known(noisy):
    """A hundred million measurements' worth of trust leave the bodies where they were, and none lets them go."""
    equations, columns, known, fit = noisy
    triangle = weighted(equations, fit.noise)
    inertial = np.array(columns.kinds) == "inertia"
    results = [fit_consistent(triangle, columns, known, regularisation=strength) for strength in (1e8, 1.0, 1e-3)]
    np.testing.assert_allclose(results[0].theta[inertial], known[inertial], rtol=1e-2, atol=1e-3)
    departures = [fit.divergence.sum() for fit in results]
    assert departures[0] < 1e-3 < departures[1] < departures[2]
    with pytest.raises(InputError, match="regularisation"):
        fit_consistent(triangle, columns, known, regularisation=0.0)


def sum_of(theta, triangle, columns, known):
    """F by its definition, with unit regularisation, as a function of logarithms of the coefficients."""
    kinds = np.array(columns.kinds)
    errors = triangle[:, :-1] @ theta - triangle[:, -1]
    bodies, before = (values[kinds == "inertia"].reshape(-1, 10) for values in (theta, known))
    total = errors @ errors
    for body, other in zip(bodies, before, strict=True):
        M = np.linalg.solve(pseudo_inertia(other), pseudo_inertia(body))
        total += np.trace(M) - np.linalg.slogdet(M)[1] - 4
    return total + 0.5 * np.sum(np.log(theta[kinds == "positive"] / known[kinds == "positive"]) ** 2)


@pytest.mark.parametrize("spoiled", [False, True])
def test_no_direction_decreases_the_sum(noisy, spoiled):
    """Also with a torque turned round, where bodies lie at the edge of those that exist."""
    equations, columns, known, fit = noisy
    triangle = weighted(equations, fit.noise)
    if spoiled:
        triangle = np.linalg.qr(np.vstack([triangle[:, :-1].T, -triangle[:, -1] + triangle[:, 0]]).T, mode="r")
    positive = np.array(columns.kinds) == "positive"
    known = np.where(positive & (known == 0), 0.1, known)
    result = fit_consistent(triangle, columns, known)
    assert result.converged and result.iterations < 200 and all(is_consistent(result.theta, columns))
    least = sum_of(result.theta, triangle, columns, known)
    random = np.random.default_rng(0)
    for size in (1e-2, 1e-4):
        for _ in range(20):
            # Relative steps of each parameter; those that leave the consistent bodies have no sum.
            theta = result.theta * np.exp(size * random.normal(size=len(known)))
            if all(is_consistent(theta, columns)):
                assert sum_of(theta, triangle, columns, known) >= least * (1 - 1e-9)
    short = fit_consistent(triangle, columns, known, iterations=3)
    assert not short.converged and short.iterations == 3


def test_frames_do_not_matter():
    """The divergence is between bodies: the same for both as seen from elsewhere."""

    def divergence(one, other):
        M = np.linalg.solve(pseudo_inertia(other), pseudo_inertia(one))
        return np.trace(M) - np.linalg.slogdet(M)[1] - 4

    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    other = inertial_parameters(1.0, [0.0, 0.1, 0.1], np.diag([0.02, 0.02, 0.03]))
    there = [moved(body, turn, np.array([1.0, 2.0, -3.0])) for body in (BODY, other)]
    np.testing.assert_allclose(divergence(BODY, other), divergence(*there), rtol=1e-6)
