"""Moving horizon estimation: the most probable motion of the last samples, by Levenberg-Marquardt, in float64.

Over the first state x_0 of a window and the disturbances w_j of its N steps it minimises

    |W⁻¹ (x_0 - prior)|² + sum_j |w_j / disturbance|² + sum_j |(y_j - measured(x_j)) / noise|²
    with  x_j+1 = step(x_j, u_j, w_j)

(Rao, Rawlings and Mayne 2003). When the window moves on, its oldest sample goes into the prior by the extended Kalman
filter. For a linear process the estimate is that of the Kalman filter. For others every iteration linearises the window
again, while the extended filter linearises each sample once.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from dln_jax.control.estimate.extended import extended
from dln_jax.control.estimate.process import Belief, Filter, Innovation, Process
from dln_jax.solvers import levenberg_marquardt
from dln_jax.solvers.elimination import solve
from dln_jax.types import InputError, require_positive


class Window(NamedTuple):
    """Memory of a moving horizon estimator; samples beyond `steps` are not used yet."""

    x: Float[Array, " n"]
    """Estimate of the newest state."""
    prior: Belief
    """Belief in the oldest state of the window, before its measurement."""
    newest: Belief
    """Belief of the extended filter in the newest state; the filter's innovations are reported."""
    u: Float[Array, "N m"]
    y: Float[Array, "N+1 p"]
    seen: Bool[Array, "N+1 p"]
    w: Float[Array, "N k"]
    """Disturbances in units of their standard deviations; the next solution starts from them."""
    first: Float[Array, " n"]
    """Estimate of the oldest state."""
    steps: Int[Array, ""]
    """Steps in the window."""


def moving_horizon(
    process: Process, window: int, *, controls: int, measurements: int, disturbances: int, iterations: int = 5
) -> Filter:
    """Returns a moving horizon estimator; its memory is a `Window`.

    Args:
        process: with a constant disturbance.
        window: N, steps in the window.
        controls: m.
        measurements: p.
        disturbances: k.
        iterations: Levenberg-Marquardt iterations per measurement, from the last solution.

    Raises:
        InputError: a number is not positive, or the disturbance is a function.
    """
    require_positive(window=window, controls=controls, measurements=measurements, iterations=iterations)
    if callable(process.disturbance):
        raise InputError("the disturbance is a function of the state; a moving horizon needs constant deviations")
    kalman, N = extended(process), window

    def states(first: Array, w: Array, u: Array, count: Array) -> Array:
        deviation = process.deviation(first, u[0])

        def step(x: Array, sample: tuple[Array, Array, Array]) -> tuple[Array, Array]:
            number, u, w = sample
            x = jnp.where(number < count, process.step(x, u, deviation * w), x)
            return x, x

        _, later = jax.lax.scan(step, first, (jnp.arange(N), u, w))
        return jnp.concatenate([first[None], later])

    def residual(unknowns: dict[str, Array], memory: Window, root: Array) -> Array:
        first = memory.first + root @ unknowns["first"]
        x = states(first, unknowns["w"], memory.u, memory.steps)
        off = (memory.y - jax.vmap(process.measured)(x)) / jnp.asarray(process.noise)
        used = memory.seen & (jnp.arange(N + 1) <= memory.steps)[:, None]
        arrival = solve(memory.prior.W, first - memory.prior.x)
        return jnp.concatenate([arrival, unknowns["w"].ravel(), jnp.where(used, off, 0.0).ravel()])

    def start(belief: Belief) -> Window:
        dtype = belief.x.dtype
        return Window(
            belief.x, belief, belief,
            jnp.zeros((N, controls), dtype), jnp.zeros((N + 1, measurements), dtype),
            jnp.zeros((N + 1, measurements), bool), jnp.zeros((N, disturbances), dtype), belief.x, jnp.asarray(0),
        )  # fmt: skip

    def update(memory: Window, y: Array, seen: Array) -> tuple[Window, Innovation]:
        newest, innovation = kalman.update(memory.newest, y, seen)
        memory = memory._replace(
            newest=newest, y=memory.y.at[memory.steps].set(y), seen=memory.seen.at[memory.steps].set(innovation.seen)
        )
        # The unknowns are in units of filtered deviations, because damping is one number for all of them.
        root = kalman.update(memory.prior, memory.y[0], memory.seen[0])[0].W
        begun = levenberg_marquardt.init({"first": jnp.zeros_like(memory.first), "w": memory.w})
        one = jax.tree.map(lambda leaf: leaf[None], (memory, root))
        leaves, tree = jax.tree.flatten(one)
        solved = levenberg_marquardt.run(
            lambda unknowns, *leaves: residual(unknowns, *jax.tree.unflatten(tree, leaves)),
            begun, tuple(leaves), iterations,
        ).parameters  # fmt: skip
        first = memory.first + root @ solved["first"]
        x = states(first, solved["w"], memory.u, memory.steps)[memory.steps]
        return memory._replace(x=x, first=first, w=solved["w"]), innovation

    def predict(memory: Window, u: Array) -> Window:
        full = memory.steps == N
        x = process.step(memory.x, u, jnp.zeros(disturbances, memory.x.dtype))
        # The oldest sample leaves a full window.
        moved = kalman.predict(kalman.update(memory.prior, memory.y[0], memory.seen[0])[0], memory.u[0])
        second = states(memory.first, memory.w, memory.u, memory.steps)[1]
        prior, first = jax.tree.map(
            lambda new, old: jnp.where(full, new, old), (moved, second), (memory.prior, memory.first)
        )
        older, ys, seen, w = (
            jnp.where(full, jnp.roll(column, -1, axis=0), column)
            for column in (memory.u, memory.y, memory.seen, memory.w)
        )
        place = jnp.minimum(memory.steps, N - 1)
        count = jnp.minimum(memory.steps + 1, N)
        return Window(
            x, prior, kalman.predict(memory.newest, u), older.at[place].set(u), ys,
            seen.at[count].set(False), w.at[place].set(0.0), first, count,
        )  # fmt: skip

    return Filter(process, start, predict, update)
