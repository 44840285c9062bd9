"""No law answers with a number where its state is none: NaN in every motor, whatever its limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control import (
    EnergyGains,
    Gains,
    Hardware,
    Reference,
    TrajectoryProblem,
    computed_torque,
    energy_shaping,
    feed_forward,
    first_plan,
    gravity_compensation,
    linearise,
    lqr,
    mpc,
    partial_linearisation,
    parts_of,
    regulated,
    saturated,
    simulate,
    stateless,
    switched,
    trusted,
    value,
    with_differences,
)
from dln_jax.control.state_space import field_of
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.poles import rotary_pendulum

SCENE = rotary_pendulum(friction=1e-5)
PLANT, B, JOINTS = dynamics(SCENE.closed_form), np.asarray(SCENE.needs.actuation), SCENE.needs.joints
FIELD, GOAL = field_of(PLANT, B), np.zeros(4)
WANTED = Reference(*jnp.zeros((3, 2)))
PARTS = parts_of(B)


def laws():
    """All laws under test, as functions of x [4]."""
    at = linearise(FIELD, GOAL, np.zeros(1))
    regulator = lqr(at.A, at.B, np.eye(4), np.eye(1))
    near, cost = regulated(regulator, GOAL, at.u, JOINTS), value(regulator, GOAL, JOINTS)
    swing = energy_shaping(PLANT, PARTS, [0.0, 0.0], EnergyGains(2e7, 0.0, 0.0))
    far = lambda x: swing(x[:2], x[2:])  # noqa: E731
    # Gains of zero: a law of few coordinates.
    trackers = {make.__name__: make(PLANT, Gains(np.zeros(2), np.zeros(2))) for make in TRACKERS}
    first, otherwise = trackers["computed_torque"], trackers["feed_forward"]
    problem = TrajectoryProblem(
        lambda x, u: x + 0.01 * FIELD(x, u), lambda x, u: x @ x + u @ u, lambda x: x @ x, -0.05, 0.05
    )
    plan, act = first_plan(problem, GOAL, np.zeros((3, 1))), mpc(problem)
    differences = with_differences(far, 2, rate=500.0, cutoff=50.0)

    def seen_twice(x):
        memory, _ = differences.act(differences.start, jnp.asarray(0.0), jnp.zeros(2))
        return differences.act(memory, jnp.asarray(0.002), jnp.asarray(x[:2] + x[2:]))[1]

    return {
        **{name: lambda x, law=law: law(x[:2], x[2:], WANTED) for name, law in trackers.items()},
        "trusted": lambda x: trusted(PLANT, first, otherwise)(x[:2], x[2:], WANTED)[0],
        "regulated": near,
        "energy_shaping": far,
        "partial_linearisation": lambda x: partial_linearisation(PLANT, PARTS)(x[:2], x[2:], jnp.ones(1)),
        "switched": switched(far, near, cost, 0.1),
        "switched to itself": switched(lambda x: jnp.ones(1), lambda x: jnp.ones(1), cost, 0.1),
        "mpc": lambda x: act(x, plan)[0],
        "with_differences": seen_twice,
        "in a loop": lambda x: simulate(
            FIELD, stateless(near), x, seconds=0.002, rate=500.0, controls=1, hardware=Hardware(-0.05, 0.05)
        ).u[0],
    }


TRACKERS = (gravity_compensation, feed_forward, computed_torque)


@pytest.mark.slow
def test_no_law_answers_where_its_state_is_no_number():
    # One coordinate after another, and a state that is sound.
    bad = np.tile([0.01, 0.02, 0.03, 0.04], (9, 1))
    for place, number in enumerate([np.nan, np.inf]):
        bad[4 * place : 4 * place + 4][np.diag_indices(4)] = number
    every = laws()
    all_of = jax.jit(jax.vmap(lambda x: {name: saturated(law(x), -0.05, 0.05) for name, law in every.items()}))(bad)
    for name, answers in all_of.items():
        assert np.isnan(answers[:8]).all(), name
        assert np.isfinite(answers[8]).all(), name


def test_a_run_of_a_failure_is_none():
    law = lambda x: jnp.where(x[:1] > 0.5, jnp.nan, 1.0)  # noqa: E731
    field = lambda x, u: jnp.concatenate([x[1:], u])  # noqa: E731
    run = simulate(field, stateless(law), [0.0, 1.0], seconds=1.0, rate=100.0, controls=1)
    failed = np.isnan(run.u[:, 0])
    assert failed.any() and not failed.all() and (np.diff(failed.astype(int)) >= 0).all()
    assert pytest.approx(0.5, abs=0.02) == float(run.x[:-1][failed][0, 0])
