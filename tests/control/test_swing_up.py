"""Energy laws do the work that theory says, and a regulator has the region of attraction of its unstable mode."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax.control.energy_shaping import EnergyGains, energy_shaping, partial_linearisation, parts_of, passive_energy
from dln_jax.control.regulators import lqr, region_of_attraction, regulated
from dln_jax.control.state_space import field_of, holding_controls, linearise
from dln_jax.mechanics.dynamics import InverseForward
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.pendulums import cart_pole, rotary_pendulum, two_link_pendulum


@pytest.mark.slow
def test_active_joints_get_the_acceleration_they_are_asked_for_and_do_its_work_on_the_pole():
    for scene, conservative in (
        (cart_pole(), True),
        (rotary_pendulum(), True),
        (cart_pole(friction=0.05), False),
        (two_link_pendulum("elbow"), False),
    ):
        plant, B = dynamics(scene.closed_form), np.asarray(scene.needs.actuation)
        parts = parts_of(B)
        energy = passive_energy(plant, parts, jnp.zeros(2))
        q, qd, a = jnp.array([0.4, 1.1]), jnp.array([0.0, 2.0]), jnp.array([3.0])

        @jax.jit
        def accelerated(q, qd, a, plant=plant, parts=parts, energy=energy, B=B):
            qdd = plant.forward_dynamics(q, qd, B @ partial_linearisation(plant, parts)(q, qd, a))
            return qdd, jax.jvp(energy, (q, qd), (qd, qdd))[1], plant.mass_matrix(q)

        qdd, rate, M = accelerated(q, qd, a)
        assert qdd[parts.active[0]] == pytest.approx(3.0, rel=1e-10)
        if conservative:
            assert rate == pytest.approx(float(-qd[1] * M[1, 0] * a[0]), rel=1e-10)
            assert energy(jnp.array([5.0, 0.0]), jnp.zeros(2)) == pytest.approx(0.0, abs=1e-12)


def test_the_region_of_attraction_is_that_of_the_unstable_mode():
    """x'' = x + u with |u| <= 1 comes back from |x + x'| < 1 and from nowhere else."""
    field = lambda x, u: jnp.stack([x[1], x[0] + u[0]])  # noqa: E731
    goal = jnp.zeros(2)
    joints = ("prismatic",)
    at = linearise(field, goal, jnp.zeros(1))
    regulator = lqr(at.A, at.B, np.eye(2), np.eye(1))
    law = regulated(regulator, goal, at.u, joints)
    found = region_of_attraction(field, law, regulator, goal, joints, lower=-1.0, upper=1.0, rate=100.0, seconds=10.0)
    largest = 1 / np.sum(np.linalg.inv(regulator.S))
    assert 0.5 * largest < found.level < 1.05 * largest and found.share == 1


def test_postures_that_cannot_be_held_and_plants_without_energy_are_refused():
    scene = cart_pole()
    plant, B = dynamics(scene.closed_form), scene.needs.actuation
    plain = InverseForward(*plant[:2])
    for make, message in (
        (lambda: holding_controls(plant, [0.0, 0.3], B), "no controls hold the posture"),
        (lambda: linearise(field_of(plant, B), [0.0, 0.3, 0.0, 0.0], [0.0]), "not an equilibrium"),
        (lambda: parts_of(np.eye(2)), "at least one passive coordinate"),
        (lambda: energy_shaping(plain, parts_of(B), [0.0, 0.0], EnergyGains(1.0, 1.0, 1.0)), "has no energy"),
    ):
        with one_line(message):
            make()
