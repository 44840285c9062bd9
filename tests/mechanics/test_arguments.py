"""A Lagrangian says which states it takes, also where its parameters are traced."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

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


def test_states_of_another_size_are_refused():
    for energy, size, message in [
        (pendulums, 1, "does not take states of size 1 .*out of bounds"),
        (pendulums, 3, "does not depend on coordinate 2"),
        (without_numpy, 4, "does not depend on coordinate 2, 3"),
    ]:
        with one_line(message):
            require_size_of(energy, size)


def test_states_that_fit_are_taken():
    require_size_of(without_numpy, 2)
    require_size_of(lambda q, qd: 0.5 * qd[0] ** 2 + jnp.cos(q[0] - q[1]), 2)
    require_size_of(lambda q, qd: 0.5 * qd[0] ** 2 - q[1] ** 2, 2)


def test_an_energy_that_is_wrong_in_itself_is_not_blamed_on_the_state():
    for energy, message in [
        (lambda q, qd: 0.5 * qd @ qd - jnp.cos(q[:1]), r"not a scalar \(Gradient only .* had shape: \(1,\)\)"),
        (lambda q, qd: None, "an energy of the system is not a scalar"),
        (lambda q, qd: 0.5 * np.dot(np.asarray(qd), np.asarray(qd)), "NumPy or Python numbers .*; use jax.numpy"),
        (lambda q, qd: 0.5 * qd @ qd + (q[0] if q[0] > 0 else 0.0), "NumPy or Python numbers"),
        (lambda q, qd, shape: 0.5 * qd @ qd, "missing 1 required positional argument: 'shape'"),
    ]:
        with pytest.raises((InputError, TypeError), match=message) as caught:
            dynamics(LagrangianSystem(energy)).forward_dynamics(*STATE)
        assert "states of size" not in str(caught.value) and "\n" not in str(caught.value)


def torque(mass, size=2):
    system = LagrangianSystem(lambda q, qd: mass * pendulums(q, qd), None)
    return dynamics(system).inverse_dynamics(*(vector[:size] for vector in STATE))[0]


def test_masses_may_be_traced_and_do_not_hide_a_state_that_is_too_short():
    slope = STATE[2][0] + np.sin(STATE[0][0])
    np.testing.assert_allclose(jax.grad(torque)(3.0), slope, rtol=1e-5)
    np.testing.assert_allclose(jax.jit(torque)(3.0), 3 * slope, rtol=1e-5)
    np.testing.assert_allclose(jax.vmap(torque)(jnp.full(3, 3.0)), 3 * slope, rtol=1e-5)
    with one_line("does not take states of size 1"):
        jax.grad(lambda mass: torque(mass, size=1))(2.0)
