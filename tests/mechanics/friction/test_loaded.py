"""Friction by load: its formula, that its inverse is exact, and what each record makes of it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax import joint_dissipation
from dln_jax.mechanics import jacobians
from dln_jax.mechanics.dynamics import InverseForward, PhaseRates
from dln_jax.mechanics.equations import dynamics, flow
from dln_jax.mechanics.joint_friction import Load, carried, carrying, with_friction
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.mechanics.natural import NaturalHamiltonian, NaturalSystem
from dln_jax.scenes.pendulums import two_link_arm

ARM = two_link_arm()
SHARE, V = np.array([0.3, 0.1]), 0.02
J = np.array([[1.0, 0.0], [-1.0, 1.0]])
D = joint_dissipation([0.2, 0.1], [0.5, 0.3], 0.05, stribeck=0.2, velocity_scale=V)
STATE = np.array([0.3, -0.8]), np.array([0.015, -0.4]), np.array([2.0, -1.0])


known = dynamics(ARM.closed_form)
torque_of_the_arm = jax.jit(known.inverse_dynamics)
RECORDS = {
    "natural": NaturalSystem(lambda q: jnp.linalg.cholesky(ARM.mass_matrix(q)), ARM.potential),
    "closed-form": ARM.closed_form,
    "lagrangian": LagrangianSystem(ARM.lagrangian),
    "hamiltonian": NaturalHamiltonian(lambda q: jnp.linalg.cholesky(jnp.linalg.inv(ARM.mass_matrix(q))), ARM.potential),
    "plain": InverseForward(known.inverse_dynamics, known.forward_dynamics),
}


@pytest.mark.parametrize("name", RECORDS)
def test_torque_is_the_formula_and_forward_undoes_it(name):
    """In absolute angles."""
    dissipation = joint_dissipation([0.2, 0.1], [0.5, 0.3], 0.05, velocity_scale=V, joint_map=J)
    system = dynamics(with_friction(RECORDS[name], dissipation, Load(SHARE, V, J)))
    q, qd, qdd = STATE
    rates, link = J @ qd, np.linalg.solve(J.T, torque_of_the_arm(q, qd, qdd))
    dry = np.tanh(rates / V)
    at_joints = link + SHARE * abs(link) * dry + [0.2, 0.1] * rates + [0.5, 0.3] * dry + 0.05
    tau = jax.jit(system.inverse_dynamics)(q, qd, qdd)
    np.testing.assert_allclose(tau, J.T @ at_joints, rtol=1e-11)
    np.testing.assert_allclose(jax.jit(system.forward_dynamics)(q, qd, tau), qdd, rtol=1e-9)


@pytest.mark.parametrize("name", ["natural", "hamiltonian"])
def test_jacobians_are_differences(name):
    system = with_friction(RECORDS[name], D, Load(SHARE, V))
    q, qd, qdd = map(jnp.asarray, STATE)
    motion = dynamics(system)
    tau, h = jax.jit(motion.inverse_dynamics)(q, qd, qdd), 1e-6
    forward = jax.jit(motion.forward_dynamics)
    qdd_again, by = jax.jit(functools.partial(jacobians.forward_dynamics_jacobians, system))(q, qd, tau)
    np.testing.assert_allclose(qdd_again, qdd, rtol=1e-9)
    at = jnp.concatenate([q, qd, tau])
    ends = [[forward(*jnp.split(at + side * h * unit, 3)) for unit in np.eye(6)] for side in (1, -1)]
    differences = (np.array(ends[0]) - np.array(ends[1])).T / (2 * h)
    np.testing.assert_allclose(np.concatenate(by, axis=1), differences, rtol=1e-5, atol=1e-5)


def test_nothing_carried_is_where_its_slope_is_that_of_no_load():
    load, qd = Load(SHARE, V), jnp.array([1.0, -1.0])
    for function in (carrying, carried):
        assert function(load, qd, jnp.zeros(2)).tolist() == [0, 0]
        np.testing.assert_array_equal(jax.jacfwd(lambda tau, f=function: f(load, qd, tau))(jnp.zeros(2)), np.eye(2))
    tau = jnp.array([-3.0, 2.0])
    np.testing.assert_allclose(carried(load, qd, carrying(load, qd, tau)), tau, rtol=1e-15)


@pytest.mark.parametrize(
    ("name", "load"),
    [("natural", Load(SHARE, V)), ("lagrangian", Load(SHARE, V)), ("hamiltonian", None), ("rates", Load(SHARE, V))],
)
def test_free_motion_loses_what_friction_takes(name, load):
    q, qd, _ = map(jnp.asarray, STATE)
    p = ARM.mass_matrix(q) @ qd
    free = RECORDS["natural"]
    system = PhaseRates(flow(free).rates) if name == "rates" else RECORDS[name]
    velocity, change = flow(with_friction(system, D, load)).rates(q, p)
    np.testing.assert_allclose(velocity, qd, rtol=1e-10)
    rubbing = dynamics(with_friction(free, D, load))
    lost = known.forward_dynamics(q, qd, 0 * q) - rubbing.forward_dynamics(q, qd, 0 * q)
    np.testing.assert_allclose(flow(free).rates(q, p)[1] - change, ARM.mass_matrix(q) @ lost, rtol=1e-9)
