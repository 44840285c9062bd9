"""A Lagrangian says which states it takes, also where its parameters are traced."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.mechanics.arguments import require_size_of
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.types import InputError

STATE = np.array([0.1, 0.2]), np.array([0.5, -0.3]), np.array([1.0, 2.0])


def pendulums(q, qd):
    return 0.5 * (qd[0] ** 2 + qd[1] ** 2) + jnp.cos(q[0]) + jnp.cos(q[1])


def without_numpy(q, qd):
    """The same, of JAX's arrays alone."""
    return pendulums(q.at[0].set(q[0]), qd)


@pytest.mark.parametrize(
    "energy, size, message",
    [
        (pendulums, 1, "takes no states of size 1 .*out of bounds"),
        (pendulums, 3, "does not depend on coordinate 2"),
        (without_numpy, 4, "does not depend on coordinate 2, 3"),
    ],
)
def test_states_of_another_size_are_refused(energy, size, message):
    with pytest.raises(InputError, match=message) as caught:
        require_size_of(energy, size)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "energy",
    [
        pendulums,
        without_numpy,
        lambda q, qd: 0.5 * qd @ qd,
        lambda q, qd: 0.5 * qd[0] ** 2 + jnp.cos(q[0] - q[1]),
        lambda q, qd: 0.5 * qd[0] ** 2 - q[1] ** 2,
    ],
    ids=["pendulums", "JAX's arrays alone", "no potential", "no second rate", "apart"],
)
def test_states_that_fit_are_taken(energy):
    require_size_of(energy, 2)


@pytest.mark.parametrize(
    "energy, message",
    [
        (lambda q, qd: 0.5 * qd @ qd - jnp.cos(q[:1]), r"no scalar \(Gradient only .* had shape: \(1,\)\)"),
        (lambda q, qd: None, "an energy of the system is no scalar"),
        (lambda q, qd: 0.5 * np.dot(np.asarray(qd), np.asarray(qd)), "NumPy or Python numbers .*; use jax.numpy"),
        (lambda q, qd: 0.5 * qd @ qd + float(q[0]), "NumPy or Python numbers"),
        (lambda q, qd: 0.5 * qd @ qd + (q[0] if q[0] > 0 else 0.0), "NumPy or Python numbers"),
        (lambda q, qd, shape: 0.5 * qd @ qd, "missing 1 required positional argument: 'shape'"),
    ],
)
def test_an_energy_that_is_wrong_in_itself_is_not_blamed_on_the_state(energy, message):
    with pytest.raises((InputError, TypeError), match=message) as caught:
        dynamics(LagrangianSystem(energy)).forward_dynamics(*STATE)
    assert "states of size" not in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("transform", [jax.grad, jax.jit, lambda f: lambda m: jax.vmap(f)(jnp.full(3, m))[1]])
def test_masses_may_be_traced(transform):
    def torque(mass):
        system = LagrangianSystem(lambda q, qd: 0.5 * mass * qd @ qd + jnp.sum(jnp.cos(q)), None)
        return dynamics(system).inverse_dynamics(*STATE)[1]

    expected = STATE[2][1] if transform is jax.grad else 3.0 * STATE[2][1] + np.sin(STATE[0][1])
    np.testing.assert_allclose(transform(torque)(3.0), expected, rtol=1e-5)


def test_traced_masses_do_not_hide_a_state_that_is_too_short():
    def torque(mass):
        system = LagrangianSystem(lambda q, qd: mass * pendulums(q, qd), None)
        return dynamics(system).inverse_dynamics(*(vector[:1] for vector in STATE))[0]

    with pytest.raises(InputError, match="takes no states of size 1"):
        jax.grad(torque)(2.0)
