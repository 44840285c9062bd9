"""Repeated plans: recovery from any state, such as after a push, by predictive control that plans again on the way.

Where the cost to go of the regulator is below a level, the regulator acts and nothing is planned. Elsewhere,
`real_time.prepare` improves a set of plans in every step of the horizon. The cheapest plan acts, with its control and
its gains about the predicted states. When the state leaves the region, all plans restart there with the controls of
their first guesses. A non-finite plan restarts in any step.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from dln_jax.control.closed_loop import Controller
from dln_jax.control.real_time import feedback, prepare
from dln_jax.control.state_space import where_finite
from dln_jax.control.trajectories import Plan, first_plan
from dln_jax.types import require_positive

LENGTHS = (1.0, 0.5, 0.25, 0.125, 0.0625)
"""Step lengths of an iteration."""
DAMPING = (1e-5, 10.0)
"""Range of the damping before an iteration. In real time there are too few iterations to let a smaller damping grow."""
RENEWING = 5
"""Iterations on restarted plans when the state leaves the region of the regulator."""


class Recovery(NamedTuple):
    """Memory of a controller by repeated plans."""

    near: Bool[Array, ""]
    """True while the regulator acts."""
    plans: Plan
    """Plans for the next step, along a leading axis."""
    acting: tuple[Float[Array, " m"], Float[Array, "m n"], Float[Array, " n"], Float[Array, " n"]]
    """Control and gains of the present step, and the states expected at its start and its end."""
    parameters: Any


def recovery_by_plans(
    problem: Any,
    plans: Plan,
    near: Callable[..., Array],
    cost: Callable[..., Array],
    level: Any,
    *,
    rate: float,
    every: int,
    parameters: Any = None,
) -> Controller:
    """Returns the controller x [n] -> u [m].

    Args:
        problem: over the horizon, in steps of `every` samples.
        plans: first guesses along a leading axis, such as by `jax.vmap(first_plan)`; only their controls count.
        near: x -> u of the regulator.
        cost: x -> cost to go, such as `value(regulator, goal, joints)`.
        level: the regulator acts while the cost to go is below it.
        rate: sampling rate, Hz.
        every: samples per step.
        parameters: tree of arrays in the memory that another controller may change; by default none. `problem` is then
            a function of them, and `near` and `cost` take them as last argument.

    Raises:
        InputError: a number is not positive, or `improve` refuses the problem.
    """
    require_positive(rate=rate, every=every)

    def planned(memory: Recovery, x: Array, within: Array) -> Recovery:
        now = problem if memory.parameters is None else problem(memory.parameters)
        fresh = jax.vmap(lambda u: first_plan(now, x, u))(plans.u)
        going = memory.plans._replace(damping=jnp.clip(memory.plans.damping, *DAMPING))
        again = memory.near | ~(jnp.isfinite(going.cost) & jnp.isfinite(going.K).all(axis=(1, 2, 3)))
        chosen = jax.vmap(lambda again, *pair: jax.tree.map(lambda new, old: jnp.where(again, new, old), *pair))
        started = chosen(again, fresh, going)
        controls = jax.vmap(lambda plan: feedback(now, plan, x))(started)
        # A number of iterations instead of a condition: under `vmap`, it is one for all lanes, unless a lane has just
        # left the goal.
        turns = jnp.where(memory.near & ~within, RENEWING, 1)
        after = jax.vmap(lambda plan: prepare(now, plan, x, iterations=turns, step_lengths=LENGTHS))(started)
        best = jnp.argmin(jnp.where(jnp.isfinite(after.cost), after.cost, jnp.inf))
        acting = controls[best], started.K[best, 0], x, after.x[best, 0]
        return memory._replace(near=jnp.zeros_like(memory.near), plans=after, acting=acting)

    def act(memory: Recovery, t: Array, x: Array) -> tuple[Recovery, Array]:
        last = () if memory.parameters is None else (memory.parameters,)
        now = problem if memory.parameters is None else problem(memory.parameters)
        seen = jnp.isfinite(x).all()
        within = jnp.where(seen, cost(x, *last) <= level, memory.near)
        # Plans continue from their predicted state.
        known = jnp.where(seen, x, memory.acting[3])
        # The time counts the steps, because all lanes of a `vmap` share it; with a counter in memory they would plan at
        # every sample.
        number = jnp.round(t * rate).astype(int) % every
        # The regulator takes over at any sample, but a plan only at the start of a step.
        kept = lambda memory, x, within: memory  # noqa: E731
        if_away = lambda *args: jax.lax.cond(within, kept, planned, *args)  # noqa: E731
        memory = jax.lax.cond(number == 0, if_away, kept, memory, known, within)
        memory = memory._replace(near=memory.near | within)
        u, K, begin, end = memory.acting
        along = u + K @ (x - begin - number / every * (end - begin))
        u = jnp.where(memory.near, near(x, *last), jnp.clip(along, now.lower, now.upper))
        return memory, where_finite(u, x)

    x, u, K = plans.x[0, 0], plans.u[0, 0], plans.K[0, 0]
    return Controller(Recovery(jnp.asarray(True), plans, (u, K, x, x), parameters), act)
