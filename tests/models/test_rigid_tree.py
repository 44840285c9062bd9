"""The parameters of a rigid tree with known frames are found by one linear fit, and predict unseen motions."""

import functools

import jax
import numpy as np
from calls import one_line

from dln_jax.data.schema import from_arrays
from dln_jax.learning.linear import fit_linear, linearised
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.mechanics.trees import dh_frames, inertial_parameters, serial, tree_system
from dln_jax.models.rigid_tree import make_rigid_tree

FRAMES = dh_frames([[0, 0, 0.3, 0], [-np.pi / 2, 0, 0, 0], [np.pi / 2, 0.1, 0.4, 0.2]])
LINKS = [inertial_parameters(m, [0.05, -0.02, 0.1], np.diag([0.02, 0.03, 0.01])) for m in (3.0, 2.0, 1.0)]
ARM = serial(*FRAMES, LINKS, armature=[0.1, 0.2, 0.05])
FRICTION = {"viscous": [0.2, 0.1, 0.3], "coulomb": [0.5, 0.3, 0.1], "offset": [0.1, 0.0, -0.2]}


@functools.cache
def torque_of(friction):
    dissipation = joint_dissipation(*FRICTION.values()) if friction else None
    return jax.jit(jax.vmap(dynamics(tree_system(ARM, dissipation)).inverse_dynamics))


def data(seed, noise, *, friction, samples=300):
    random = np.random.default_rng(seed)
    state = random.normal(size=(3, samples, 3))
    tau = torque_of(friction)(*state)
    arrays = dict(zip(("q", "qd", "qdd"), state, strict=True))
    trajectory = np.arange(samples)
    return from_arrays(
        {**arrays, "t": np.zeros(samples), "tau": tau + noise * random.normal(size=tau.shape), "trajectory": trajectory}
    )


def torques(model, parameters, data):
    return jax.jit(jax.vmap(dynamics(model.energies(parameters)).inverse_dynamics))(data.q, data.qd, data.qdd)


def test_a_fit_is_exact_and_knows_what_it_cannot_know():
    model = make_rigid_tree(ARM, friction=True)
    train, test = (data(seed, 0.0, friction=True) for seed in range(2))
    fit = fit_linear(model, train, negligible=1e-12)
    rows = jax.jit(jax.vmap(lambda *state: linearised(model, fit.parameters, *state)[0]))
    columns = np.asarray(rows(train.q, train.qd, train.qdd)).reshape(-1, 33 + 9)
    assert fit.rank == np.linalg.matrix_rank(columns, rtol=1e-10) == 16 + 9
    assert fit.parameter_count == 33 + 9 and fit.condition < 10
    predicted = torques(model, fit.parameters, test)
    assert np.abs(predicted - test.tau).max() < 1e-10 * np.abs(test.tau).max()
    for name, values in FRICTION.items():
        np.testing.assert_allclose(getattr(fit.parameters, name), values, atol=1e-9)


def test_noise_is_averaged():
    model, noise = make_rigid_tree(ARM), 0.1
    fit = fit_linear(model, data(0, noise, friction=False), negligible=1e-12)
    test = data(1, 0.0, friction=False)
    predicted = torques(model, fit.parameters, test)
    # Of 900 equations the fit takes one for each parameter that it determines.
    expected = noise * np.sqrt(fit.rank / 900)
    assert 0.5 * expected < np.sqrt(np.mean((predicted - test.tau) ** 2)) < 2 * expected


def test_frictions_that_no_tree_has_are_refused():
    for keywords, message in (
        ({"friction": True, "velocity_scale": 0.0}, "velocity_scale"),
        ({"friction": ("viscous",), "load": 0.1}, "load is 0.1, but friction has viscous; add 'load'"),
        ({"friction": ("load",), "load": 1.0}, "load is 1.0; expected a share"),
        ({"friction": ("asymmetric", "viscous")}, "no data can tell apart"),
        ({"friction": ("stribeck",), "stribeck_velocity": (0.1, -1.0, 0.1)}, "stribeck_velocity is"),
    ):
        with one_line(message):
            make_rigid_tree(ARM, **keywords)


def test_load_is_no_linear_friction():
    model = make_rigid_tree(ARM, friction=("viscous", "load"), load=0.1)
    with one_line("not linear in its parameters"):
        fit_linear(model, data(0, 0.0, friction=False), negligible=1e-12)
