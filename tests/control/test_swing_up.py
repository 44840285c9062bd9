"""Energy laws do the work that theory says, and swing up three plants from many starts within their limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control import (
    EnergyGains,
    Hardware,
    energy_shaping,
    error,
    field_of,
    holding_controls,
    linearise,
    lqr,
    partial_linearisation,
    parts_of,
    passive_energy,
    region_of_attraction,
    regulated,
    simulate,
    stateless,
    switched,
    value,
)
from dln_jax.mechanics.dynamics import PlainDynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.pendulums import two_link_pendulum
from dln_jax.scenes.poles import cart_pole, rotary_pendulum
from dln_jax.types import InputError, JointKind

SCENES = [
    cart_pole(friction=0.05),
    rotary_pendulum(friction=1e-5),
    two_link_pendulum("elbow"),
    two_link_pendulum("shoulder"),
]


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)
def test_active_joints_get_the_acceleration_they_are_asked_for(scene):
    plant, parts = dynamics(scene.energies), parts_of(scene.needs.actuation)
    q, qd = jnp.array([0.4, 1.1]), jnp.array([-0.7, 2.0])
    tau = partial_linearisation(plant, parts)(q, qd, jnp.array([3.0]))
    qdd = plant.forward_dynamics(q, qd, jnp.asarray(scene.needs.actuation) @ tau)
    assert float(qdd[parts.active[0]]) == pytest.approx(3.0, rel=1e-10)


@pytest.mark.parametrize("scene", [cart_pole(), rotary_pendulum()], ids=lambda scene: scene.name)
def test_accelerating_the_arm_does_work_on_the_pole(scene):
    plant, parts = dynamics(scene.energies), parts_of(scene.needs.actuation)
    q, qd, a = jnp.array([0.4, 1.1]), jnp.array([0.0, 2.0]), jnp.array([3.0])
    tau = partial_linearisation(plant, parts)(q, qd, a)
    qdd = plant.forward_dynamics(q, qd, jnp.asarray(scene.needs.actuation) @ tau)
    energy = passive_energy(plant, parts, jnp.zeros(2))
    _, rate = jax.jvp(energy, (q, qd), (qd, qdd))
    work = -qd[1] * plant.mass_matrix(q)[1, 0] * a[0]
    assert float(rate) == pytest.approx(float(work), rel=1e-10)
    assert float(energy(jnp.array([5.0, 0.0]), jnp.zeros(2))) == pytest.approx(0.0, abs=1e-12)


def swing_up(scene, gains, Q, R, level):
    """Law and field of a swing-up to the upright posture."""
    plant, B = dynamics(scene.energies), np.asarray(scene.needs.actuation)
    field, joints = field_of(plant, B), scene.needs.joints
    goal = jnp.zeros(4)
    at = linearise(field, goal, holding_controls(plant, goal[:2], B))
    regulator = lqr(at.A, at.B, Q, R)
    far = energy_shaping(plant, parts_of(B), goal[:2], gains)
    cost = value(regulator, goal, joints)
    law = switched(lambda x: far(*jnp.split(x, 2)), regulated(regulator, goal, at.u, joints), cost, level)
    return law, field, goal


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "gains", "Q", "R", "most", "level"),
    [
        (cart_pole(), EnergyGains(200.0, 2.0, 2.0), np.diag([1, 1, 0.1, 0.1]), [[0.1]], 10.0, 0.5),
        (rotary_pendulum(), EnergyGains(2e7, 20.0, 5.0), np.diag([1, 1, 0.01, 0.01]), [[50.0]], 0.05, 0.1),
    ],
    ids=["cart-pole", "rotary-pendulum"],
)
def test_it_swings_up_from_every_start(scene, gains, Q, R, most, level):
    law, field, goal = swing_up(scene, gains, Q, R, level)
    random = np.random.default_rng(0)
    starts = np.zeros((16, 4))
    starts[:, 1] = np.pi + random.normal(size=16) * 0.1
    starts[:, 0] = 0.1 * random.normal(size=16)
    lab = Hardware(-most, most)
    run = jax.jit(jax.vmap(lambda x: simulate(
        field, stateless(law), x, seconds=10.0, rate=200.0, controls=1, hardware=lab
    )))(starts)  # fmt: skip
    assert np.abs(run.u).max() <= most
    off = jax.vmap(lambda x: error(x, goal, scene.needs.joints))(run.x[:, -1])
    assert np.abs(off[:, 1]).max() < 1e-2


def test_the_region_of_attraction_is_that_of_the_unstable_mode():
    # x'' = x + u with |u| <= 1 comes back from |x + x'| < 1 and from nowhere else.
    field = lambda x, u: jnp.stack([x[1], x[0] + u[0]])  # noqa: E731
    goal = jnp.zeros(2)
    joints: tuple[JointKind, ...] = ("prismatic",)
    at = linearise(field, goal, jnp.zeros(1))
    regulator = lqr(at.A, at.B, np.eye(2), np.eye(1))
    law = regulated(regulator, goal, at.u, joints)
    found = region_of_attraction(field, law, regulator, goal, joints, lower=-1.0, upper=1.0, rate=100.0, seconds=10.0)
    largest = 1 / np.sum(np.linalg.inv(regulator.S))
    assert 0.5 * largest < found.level < 1.05 * largest and found.share == 1


def test_mistakes_are_one_line():
    scene = cart_pole()
    plant = dynamics(scene.energies)
    with pytest.raises(InputError, match="no controls hold the posture"):
        holding_controls(plant, [0.0, 0.3], scene.needs.actuation)
    with pytest.raises(InputError, match="not an equilibrium"):
        linearise(field_of(plant, scene.needs.actuation), [0.0, 0.3, 0.0, 0.0], [0.0])
    with pytest.raises(InputError, match="a coordinate without a motor"):
        parts_of(np.eye(2))
    with pytest.raises(InputError, match="has no energy"):
        plain = PlainDynamics(plant.inverse_dynamics, plant.forward_dynamics, plant.decompose)
        energy_shaping(plain, parts_of(scene.needs.actuation), [0.0, 0.0], EnergyGains(1.0, 1.0, 1.0))
