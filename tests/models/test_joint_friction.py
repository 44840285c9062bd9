"""Friction in the joints of any model: its force and its parametrisation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax import joint_dissipation
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import LAWS, FrictionShape
from dln_jax.models.joint_friction import friction_of, with_joint_friction
from dln_jax.types import Needs
from dln_jax.zoo.descriptions import build, describe
from tests.models.random_parameters import drawn

ABSOLUTE = ((1.0, 0.0), (-1.0, 1.0))
NEEDS = Needs(joints=("revolute", "revolute"), joint_map=ABSOLUTE, velocity_scale=0.05)
EVERY = tuple(law for law in LAWS if law != "asymmetric")
SMALL = {"width": 4, "depth": 1}
KINDS = {
    "structured-delan": SMALL,
    "black-box-delan": {**SMALL, "activation": "softplus"},
    "feed-forward": SMALL,
    "structured-hnn": SMALL,
    "phase-network": SMALL,
    "trigonometric": {},
}
STATE = np.array([0.3, -0.8]), np.array([0.02, -0.4]), np.array([2.0, -1.0])


def model_of(kind, needs):
    return build(describe(kind, needs=needs, precision="f64", **KINDS[kind]))


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "phase-network"])
def test_every_kind_has_the_friction_that_its_needs_name(kind):
    linear = kind == "trigonometric"
    laws = tuple(law for law in EVERY if law != "load" or not linear)
    model, bare = model_of(kind, NEEDS._replace(joint_friction=laws)), model_of(kind, NEEDS)
    parameters = drawn(model)
    free, motion = dynamics(bare.energies(parameters["model"])), dynamics(model.energies(parameters))
    q, qd, qdd = STATE
    J = np.array(ABSOLUTE)
    coefficients, shape = friction_of(parameters["friction"], FrictionShape(velocity_scale=0.05), linear=linear)
    force = jax.grad(joint_dissipation(**coefficients._asdict(), **shape._asdict()), argnums=1)(jnp.zeros(2), J @ qd)
    share = 1 / (1 + np.exp(-parameters["friction"].shape.get("load", -np.inf))) * np.tanh(J @ qd / 0.05)

    @jax.jit
    def ask():
        tau = motion.inverse_dynamics(*STATE)
        return free.inverse_dynamics(*STATE), tau, motion.forward_dynamics(q, qd, tau)

    torque, tau, again = ask()
    link = np.linalg.solve(J.T, torque)
    np.testing.assert_allclose(tau, J.T @ (link + abs(link) * share + force), rtol=1e-9)
    if kind != "feed-forward":
        np.testing.assert_allclose(again, qdd, rtol=1e-7, atol=1e-7)


def test_what_is_trained_takes_power_whatever_the_parameters():
    """No coefficient is negative, but for the offset, and the share of the load is below 1."""
    model = model_of("structured-delan", NEEDS._replace(joint_friction=EVERY))
    for seed in range(5):
        friction = drawn(model, seed, size=10)["friction"]
        coefficients, _ = friction_of(friction, FrictionShape())
        rest = coefficients._replace(offset=None)
        assert all((leaf >= 0).all() for leaf in jax.tree.leaves(rest))


def test_learned_shapes_start_where_they_are_stated_and_the_scale_is_held():
    needs = NEEDS._replace(joint_friction=("stribeck", "sigmoid"))
    model = model_of("structured-delan", NEEDS)
    start = FrictionShape(0.03, 0.2, 15.0, -0.01)
    friction = with_joint_friction(model, needs, shape=start).init(jax.random.key(0))["friction"]
    assert set(friction.shape) == {"stribeck_velocity", "sigmoid_slope", "sigmoid_shift"}
    found = friction_of(friction, start)[1]
    np.testing.assert_allclose(np.stack(found[1:]), np.tile([[0.2], [15.0], [-0.01]], 2), rtol=1e-6)
    assert found.velocity_scale == 0.03
    assert with_joint_friction(model, NEEDS) is model


def test_what_a_model_cannot_have_is_refused():
    for kind, laws, message in [
        ("trigonometric", ("load",), "the model is not linear in its parameters; leave load out"),
        ("structured-delan", ("rust",), r"joint_friction: \('rust',\); expected a tuple of viscous"),
        ("polynomial-hamiltonian", ("viscous",), "conserves energy"),
        ("pairwise-hnn", ("viscous",), "no friction"),
    ]:
        needs = Needs(joints=("prismatic",) * 4 if kind == "pairwise-hnn" else ("revolute",) * 2)
        description = describe(kind, needs=needs, precision="f64")
        with one_line(message):
            build(description | {"needs": needs._replace(joint_friction=laws)._asdict()})
