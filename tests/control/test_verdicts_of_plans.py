"""A plan that converged keeps all constraints: obstacles, walls, and limits of controls and durations."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control import TrajectoryProblem, free_time, optimise, shoot, worst_violation
from dln_jax.solvers.ending import Ending, reason

N, DT = 16, 0.1


def into_disc(x):
    """Squared depth of the middle of the outer link and of the tip of an arm of two links of 1 m in a disc."""
    elbow = jnp.stack([jnp.cos(x[0]), jnp.sin(x[0])])
    tip = elbow + jnp.stack([jnp.cos(x[0] + x[1]), jnp.sin(x[0] + x[1])])
    centre = jnp.array([1.6, 0.1])
    return jnp.stack([0.3**2 - jnp.sum((point - centre) ** 2) for point in ((elbow + tip) / 2, tip)])


def test_an_arm_that_converged_is_never_inside_a_disc():
    """From eight guesses, most of which cross the disc."""
    first, last = np.array([-0.8, 0.4, 0.0, 0.0]), np.array([0.8, 0.4, 0.0, 0.0])
    problem = TrajectoryProblem(
        lambda x, u: jnp.concatenate([x[:2] + DT * x[2:] + DT**2 / 2 * u, x[2:] + DT * u]),
        lambda x, u: 0.1 * DT * u @ u, lambda x: 50 * jnp.sum((x - last) ** 2), -8.0, 8.0, states=into_disc,
    )  # fmt: skip
    bend = np.sin(np.pi * np.linspace(0, 1, N + 1))[:, None] * [0.0, 1.0, 0.0, 0.0]
    guesses = np.linspace(first, last, N + 1) + np.linspace(-1.0, 2.5, 8)[:, None, None] * bend
    solutions = jax.jit(jax.vmap(lambda guess: shoot(problem, first, guess, np.zeros((N, 2)))))(guesses)
    depth = np.asarray(jax.vmap(jax.vmap(into_disc))(solutions.plan.x[:, 1:])).max(axis=(1, 2))
    converged = np.asarray(solutions.ending) == Ending.CONVERGED
    assert (depth[converged] <= 1e-6).all() and converged.sum() >= 6


@pytest.mark.parametrize(("soft", "ending"), [(None, Ending.INFEASIBLE), ((1.0, 0.0), Ending.EXCEEDED)])
def test_a_mass_that_passes_the_wall_across_its_way_has_not_converged(soft, ending):
    """A mass is to move by 1 m, and the wall is between 0.3 and 0.7 m; a low price lets it pass."""
    problem = TrajectoryProblem(
        lambda x, u: jnp.stack([x[0] + DT * x[1] + DT**2 / 2 * u[0], x[1] + DT * u[0]]),
        lambda x, u: DT * u @ u, lambda x: 0.0 * x[0], -2.0, 2.0, states=lambda x: 0.04 - (x[:1] - 0.5) ** 2,
        end=lambda x: x - jnp.array([1.0, 0.0]), soft=soft,
    )  # fmt: skip
    solution = jax.jit(lambda: shoot(problem, np.zeros(2), np.zeros((N + 1, 2)), np.zeros((N, 1))))()
    assert int(solution.ending) == ending and not solution.converged
    if soft is None:
        assert np.isinf(solution.objective)
    else:
        excess = np.maximum(0.04 - (np.asarray(solution.plan.x[:, 0]) - 0.5) ** 2, 0.0)
        assert float(solution.objective - solution.plan.cost) == pytest.approx(excess.sum(), rel=1e-6)
        assert float(solution.violation) == pytest.approx(excess.max()) and excess.max() > 0.03
        assert reason(solution.ending).startswith("is optimal at its prices, but violates soft constraints")
        assert worst_violation(problem, solution.plan).startswith("constraint 0 on the states at knot")


@pytest.mark.parametrize("solve", ["shoot", "optimise"])
def test_the_best_of_several_guesses_has_the_least_objective(solve):
    """A well of value 0 at -1, whose price is 5, beats no well of value 0.5 at 1, which costs nothing more."""
    problem = TrajectoryProblem(
        lambda x, u: x + u, lambda x, u: 0.0 * u[0], lambda x: 10 * (x[0] ** 2 - 1) ** 2 + 0.25 * (x[0] + 1),
        states=lambda x: -x, soft=(5.0, 0.0),
    )  # fmt: skip
    start = np.array([0.05])
    states, u = (np.array([[[0.05], [end]] for end in (1.0, -1.0)]), np.array([[[end - 0.05]] for end in (1.0, -1.0)]))
    if solve == "shoot":
        plan = jax.jit(lambda: shoot(problem, start, states[0], u[0], starts=(states[1:], u[1:])).plan)()
    else:
        plan = jax.jit(lambda: optimise(problem, start, u[0], starts=u[1:]))()
    assert float(plan.x[-1, 0]) > 0.9 and plan.converged


@functools.cache
def sideways(solve):
    """A unicycle, at most 1 m/s and 2 rad/s, moves sideways by 1 m in the shortest time, in ten equal steps."""

    def step(x, u, dt):
        heading = x[2] + dt / 2 * u[1]
        return x + dt * jnp.stack([u[0] * jnp.cos(heading), u[0] * jnp.sin(heading), u[1]])

    problem = free_time(step, lambda x, u, dt: dt, lambda x: 0.0 * x[0], states=3, shortest=1e-3, longest=0.5)._replace(
        lower=np.array([-1.0, -2.0]), upper=np.array([1.0, 2.0]), end=lambda x: x[:3] - np.array([0.0, 1.0, 0.0])
    )
    if solve == "optimise":
        return jax.jit(lambda x, states, u: optimise(problem, x, u))
    return jax.jit(lambda x, states, u: shoot(problem, x, states, u).plan)


@pytest.mark.slow
@pytest.mark.parametrize("solve", ["shoot", "optimise"])
def test_limits_of_controls_and_durations_hold_in_every_plan(solve):
    """Also where slacks are widened; turning on the spot and driving there and back takes at least 1 s."""
    random, converged = np.random.default_rng(0), []
    for number in range(7):
        x, u = np.array([0.0, 0.0, 0.0, (0.1, 0.3, 0.02)[number % 3]]), random.uniform(-1, 1, (10, 2))
        plan = sideways(solve)(x, np.linspace(x, [0.0, 1.0, 0.0, x[3]], 11), u)
        assert (np.abs(plan.u) <= np.array([1.0, 2.0]) + 1e-6).all()
        assert plan.x[:, 3].min() >= 1e-3 - 1e-6 and plan.x[:, 3].max() <= 0.5 + 1e-6
        assert not plan.converged or plan.cost > 1.0
        converged.append(bool(plan.converged))
    assert np.mean(converged) > 0.7
