"""Targets are costs along trajectories, with their slopes; iterations find the value that is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from dln_jax.control.optimal.action_costs import limited_atan, quadratic
from dln_jax.control.optimal.fitted import Iteration, fit_value, fit_values, targets
from dln_jax.control.optimal.problem import (
    ControlProblem,
    drawn,
    flow,
    optimal_control,
    widened,
    worst_disturbance,
)
from dln_jax.control.optimal.value_networks import value_network
from dln_jax.control.regulators import lqr

PENDULUM = ControlProblem(
    lambda x: jnp.stack([x[1], 10 * jnp.sin(x[0])]),
    lambda x: jnp.array([[0.0], [3.0]]),
    lambda x: 4 * jnp.sin(x[0] / 2) ** 2 + 0.1 * x[1] ** 2,
    limited_atan(2.5, 2.0),
    0.1,
    [-np.pi, -8.0],
    [np.pi, 8.0],
    ("revolute",),
    [0.0, 0.0],
)
LINE = ControlProblem(
    lambda x: x, lambda x: jnp.ones((1, 1)), lambda x: 0.5 * x @ x, quadratic(1.0), 0.2, [-2.0], [2.0], (), [0.0]
)
NETWORK = value_network(PENDULUM, widths=(8,), scale=10.0)


def test_targets_are_weighted_returns_and_their_slopes():
    parameters = NETWORK.init(jax.random.key(0))
    value = lambda x: NETWORK.value_and_gradient(parameters, x)  # noqa: E731
    x = jnp.array([2.0, 1.0])
    steps = 4
    dt = 0.02
    step = flow(PENDULUM, dt, clipped=True)
    discount = np.exp(-0.1 * dt)

    def weighted_returns(x, memory):
        """The sum over n of weights times the return of n steps, as it is printed."""
        w = jnp.exp(-dt / memory)
        weights = jnp.append((1 - w) * w ** jnp.arange(steps - 1), w ** (steps - 1))

        def onwards(carry, n):
            x, total = carry
            after, cost = step(x, optimal_control(PENDULUM, x, value(x)[1]))
            total = total + discount**n * cost
            return (after, total), total + discount ** (n + 1) * value(after)[0]

        return weights @ jax.lax.scan(onwards, (x, jnp.asarray(0.0)), jnp.arange(steps))[1]

    found = jax.jit(lambda memory: targets(PENDULUM, value, x, steps=steps, dt=dt, memory=memory))
    expected = jax.jit(jax.value_and_grad(weighted_returns))
    for memory in (0.05, 1e9):
        assert found(memory)[1][0] == pytest.approx(float(expected(x, memory)[0]), rel=1e-12)
    # With all of the memory the slope is that of the return.
    assert_allclose(found(1e9)[2][0], expected(x, 1e9)[1], rtol=1e-7)
    assert_allclose(found(0.05)[0][0], x)


def test_values_of_a_line_and_of_the_worst_of_lines_are_those_of_the_regulator():
    """dx/dt = p x + u with p off by a share: the worst is always the larger p."""
    numbers = Iteration(iterations=25, starts=64, seconds=0.5, dt=0.025, steps=40, batch=64, kept=2, learning_rate=0.05)
    network = value_network(LINE, widths=())
    for share in (0.0, 0.2):
        worst = worst_disturbance(lambda x, u, p: p * x + u, [1.0], parameters=share) if share else None
        found = fit_value(LINE, network, numbers=numbers, double=True, disturbance=worst)
        S = lqr([[0.9 + share]], [[1.0]], [[0.5]], [[0.5]]).S[0, 0]
        V, slope = network.value_and_gradient(found.parameters, jnp.array([1.5]))
        assert pytest.approx(float(S) * 1.5**2, rel=5e-3) == V and slope[0] == pytest.approx(3.0 * float(S), rel=5e-3)
        assert found.history[-1].validation <= 1.01 * min(at.validation for at in found.history)


def test_seeds_are_what_each_is_alone_also_after_an_interruption():
    network = value_network(LINE, widths=())
    numbers = Iteration(iterations=3, starts=8, seconds=0.1, steps=2, batch=8, kept=2)
    stored = []
    keep = lambda *stage: stored.append(stage)  # noqa: E731
    both = fit_values(LINE, network, (0, 1), numbers=numbers, store=keep)
    first = next(stage for seed, *stage in stored if seed == 1)
    (alone,) = fit_values(LINE, network, (1,), numbers=numbers, restore=lambda seed, like: first)
    jax.tree.map(assert_array_equal, both[1].parameters, alone.parameters)
    assert [at.validation for at in both[1].history] == [at.validation for at in alone.history]
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(alone.parameters))


def test_states_are_drawn_from_the_wide_box():
    wide = widened(PENDULUM, 1.25)
    x = drawn(wide, jax.random.key(0), 500)
    assert wide.high.tolist() == [np.pi, 10.0] and np.abs(x[:, 1]).max() > 9 and np.abs(x[:, 0]).max() <= np.pi
