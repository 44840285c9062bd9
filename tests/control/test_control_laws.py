"""No law answers with a number where its state is none, whatever its limits; and laws are the same in C."""

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.control.closed_loop import Hardware, simulate, stateless
from dln_jax.control.energy_shaping import EnergyGains, energy_shaping, partial_linearisation, parts_of
from dln_jax.control.observers import with_differences
from dln_jax.control.real_time import mpc
from dln_jax.control.regulators import lqr, regulated, switched, value
from dln_jax.control.state_space import field_of, linearise, saturated
from dln_jax.control.tracking import Gains, Reference, computed_torque, feed_forward, gravity_compensation, trusted
from dln_jax.control.trajectories import TrajectoryProblem, first_plan
from dln_jax.export.c.load import load_c
from dln_jax.export.c.source import export_c
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.pendulums import rotary_pendulum

SCENE = rotary_pendulum(friction=1e-5)
PLANT = dynamics(SCENE.closed_form)
B = np.asarray(SCENE.needs.actuation)
JOINTS = SCENE.needs.joints
FIELD = field_of(PLANT, B)
GOAL = np.zeros(4)
IN_C = "regulated", "switched", "computed_torque", "feed_forward"


def laws():
    """All laws under test, as functions of x [4]."""
    at = linearise(FIELD, GOAL, np.zeros(1))
    regulator = lqr(at.A, at.B, np.eye(4), np.eye(1))
    near = regulated(regulator, GOAL, at.u, JOINTS)
    cost = value(regulator, GOAL, JOINTS)
    swing = energy_shaping(PLANT, parts_of(B), [0.0, 0.0], EnergyGains(2e7, 0.0, 0.0))
    far = lambda x: swing(x[:2], x[2:])  # noqa: E731
    one = lambda x: jnp.ones(1)  # noqa: E731
    # Gains of zero: a law of few coordinates.
    makers = gravity_compensation, feed_forward, computed_torque
    trackers = {make.__name__: make(PLANT, Gains(np.zeros(2), np.zeros(2))) for make in makers}
    safe = trusted(PLANT, trackers["computed_torque"], trackers["feed_forward"])
    trackers["trusted"] = lambda *state: safe(*state)[0]
    wanted = Reference(*jnp.zeros((3, 2)))
    limits = -0.05, 0.05
    problem = TrajectoryProblem(
        lambda x, u: x + 0.01 * FIELD(x, u), lambda x, u: x @ x + u @ u, lambda x: x @ x, *limits
    )
    plan = first_plan(problem, GOAL, np.zeros((3, 1)))
    act = mpc(problem)
    differences = with_differences(far, 2, rate=500.0, cutoff=50.0)
    settings = {"seconds": 0.002, "rate": 500.0, "controls": 1, "hardware": Hardware(*limits)}

    def seen_twice(x):
        memory, _ = differences.act(differences.start, jnp.asarray(0.0), jnp.zeros(2))
        return differences.act(memory, jnp.asarray(0.002), jnp.asarray(x[:2] + x[2:]))[1]

    return {
        **{name: lambda x, law=law: law(x[:2], x[2:], wanted) for name, law in trackers.items()},
        "regulated": near,
        "energy_shaping": far,
        "partial_linearisation": lambda x: partial_linearisation(PLANT, parts_of(B))(x[:2], x[2:], jnp.ones(1)),
        "switched": switched(far, near, cost, 0.1),
        "switched to itself": switched(one, one, cost, 0.1),
        "mpc": lambda x: act(x, plan)[0],
        "with_differences": seen_twice,
        "in a loop": lambda x: simulate(FIELD, stateless(near), x, **settings).u[0],
    }


def test_no_law_answers_where_its_state_is_not_finite_in_jax_or_c(tmp_path):
    # One coordinate after another, and two states that are sound.
    bad = np.tile([0.01, 0.02, 0.03, 0.04], (10, 1))
    bad[9] = [0.7, -1.2, 0.9, 0.5]
    for place, number in enumerate([np.nan, np.inf]):
        bad[4 * place : 4 * place + 4][np.diag_indices(4)] = number
    every = laws()
    all_of = jax.jit(jax.vmap(lambda x: {name: law(x) for name, law in every.items()}))(bad)
    for name, answers in all_of.items():
        limited = saturated(answers, -0.05, 0.05)
        assert np.isnan(limited[:8]).all() and np.isfinite(limited[8:]).all(), name
    export_c({name: (every[name], (GOAL,)) for name in IN_C}, tmp_path)
    in_c = load_c(tmp_path)
    for name in IN_C:
        got = np.array([getattr(in_c, name)(x) for x in bad])
        np.testing.assert_allclose(got, all_of[name], rtol=1e-12, atol=1e-15)
