"""The parameters of a rigid tree with known frames are found by one linear fit, and predict unseen motions."""

import jax
import numpy as np
from calls import one_line
from planar_arm import ARM, FRICTION, motions

from dln_jax.learning.linear import fit_linear, linearised
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.rigid_tree import make_rigid_tree


def torques(model, parameters, data):
    return jax.jit(jax.vmap(dynamics(model.energies(parameters)).inverse_dynamics))(data.q, data.qd, data.qdd)


def test_a_fit_is_exact_and_knows_what_it_cannot_know():
    model = make_rigid_tree(ARM, friction=True)
    train, test = (motions(seed) for seed in range(2))
    fit = fit_linear(model, train, negligible=1e-12)
    rows = jax.jit(jax.vmap(lambda *state: linearised(model, fit.parameters, *state)[0]))
    columns = np.asarray(rows(train.q, train.qd, train.qdd)).reshape(-1, 22 + 6)
    columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
    assert fit.rank == np.linalg.matrix_rank(columns, rtol=1e-10) < fit.parameter_count == 22 + 6
    predicted = torques(model, fit.parameters, test)
    assert np.abs(predicted - test.tau).max() < 1e-10 * np.abs(test.tau).max()
    for name, values in FRICTION.items():
        np.testing.assert_allclose(getattr(fit.parameters, name), values, atol=1e-9)


def test_noise_is_averaged():
    model, noise = make_rigid_tree(ARM), 0.1
    fit = fit_linear(model, motions(0, noise=noise, friction=False, samples=400), negligible=1e-12)
    test = motions(1, friction=False)
    predicted = torques(model, fit.parameters, test)
    # Of 800 equations the fit takes one for each parameter that it determines.
    expected = noise * np.sqrt(fit.rank / 800)
    assert 0.5 * expected < np.sqrt(np.mean((predicted - test.tau) ** 2)) < 2 * expected


def test_frictions_that_no_tree_has_are_refused():
    for keywords, message in (
        ({"friction": True, "velocity_scale": 0.0}, "velocity_scale"),
        ({"friction": ("viscous",), "load": 0.1}, "load is 0.1, but friction has viscous; add 'load'"),
        ({"friction": ("load",), "load": 1.0}, "load is 1.0; expected a share"),
        ({"friction": ("asymmetric", "viscous")}, "no data can tell apart"),
        ({"friction": ("stribeck",), "stribeck_velocity": (0.1, -1.0)}, "stribeck_velocity is"),
    ):
        with one_line(message):
            make_rigid_tree(ARM, **keywords)


def test_load_is_no_linear_friction():
    model = make_rigid_tree(ARM, friction=("viscous", "load"), load=0.1)
    with one_line("not linear in its parameters"):
        fit_linear(model, motions(0), negligible=1e-12)
