"""Division of time steps that do not converge.

A step of dt without convergence is repeated from its start in parts of dt/2, dt/4, ..., dt/2^halvings. A part without
convergence is halved, and later parts keep the shorter length. The loop over the parts runs zero times if the step
converges.

The derivative of the step is the product of the derivatives of its parts. Loops over the parts, forwards for tangents
and backwards for cotangents, evaluate every part again from its known solution.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from dln_jax.softbody.scene import Params, State
from dln_jax.softbody.verdict import Info
from dln_jax.solvers.elements.minimise import is_constant, no_tangent

Advance = Callable[..., tuple[State, Info]]
"""(params, state, control, dt, x_after=None) -> (state, Info); x_after starts the search."""


class Parts(NamedTuple):
    """The converged parts of a step; entries from `taken` on are empty."""

    x: Float[Array, "parts n dim"]
    """Positions at the starts of the parts, in m."""
    v: Float[Array, "parts n dim"]
    x_after: Float[Array, "parts n dim"]
    """Positions at the ends of the parts, in m."""
    length: Int[Array, " parts"]
    """Lengths in units of dt/2^halvings."""
    taken: Int[Array, ""]
    """Number of parts."""


def with_shorter_steps(advance: Advance, dt: Any, halvings: int) -> Callable[..., tuple[State, Info]]:
    """Returns a step (params, state, control=None) -> (state, Info) that divides itself if necessary.

    If the shortest parts do not converge either, the result is the whole step without convergence.

    Args:
        advance: step of a one-step integrator, for any length.
        dt: length of the whole step, in s.
        halvings: the shortest part is dt/2^halvings.
    """
    most = 2**halvings

    def part_of(params: Params, state: State, control: Any, length: Array, **start: Array) -> tuple[State, Info]:
        after, info = advance(params, state, control, jnp.asarray(dt, state.x.dtype) * length / most, **start)
        # All parts share the motion of surfaces in the whole step.
        return after._replace(poses=state.poses), info

    @jax.custom_jvp
    def whole(params: Params, state: State, control: Any) -> tuple[State, Info, Parts]:
        first, info = part_of(params, state, control, jnp.asarray(most))
        blank = jnp.zeros((most, *state.x.shape), state.x.dtype)
        parts = Parts(blank, blank, blank, jnp.zeros(most, int), jnp.asarray(0))
        parts = _with_part(parts, state, first.x, jnp.asarray(most), info.converged)
        reached, done = where(info.converged, first, state), jnp.where(info.converged, most, 0)

        def unfinished(progress: tuple[Any, ...]) -> Array:
            *_, done, length = progress
            return (done < most) & (length > 0)

        def attempt(progress: tuple[Any, ...]) -> tuple[Any, ...]:
            state, so_far, parts, done, length = progress
            after, outcome = part_of(params, state, control, length)
            accepted = outcome.converged
            merged = where(parts.taken > 0, _together(so_far, outcome), outcome)
            return (
                where(accepted, after, state),
                where(accepted, merged, so_far)._replace(iterations=so_far.iterations + outcome.iterations),
                _with_part(parts, state, after.x, length, accepted),
                jnp.where(accepted, done + length, done),
                jnp.where(accepted, length, length // 2),
            )

        start = reached, info, parts, done, jnp.asarray(most // 2)
        reached, so_far, parts, done, _ = jax.lax.while_loop(unfinished, attempt, start)
        complete = done == most
        info = where(complete, so_far, info._replace(iterations=so_far.iterations))
        return where(complete, reached, first), info._replace(substeps=parts.taken), parts

    def derivative(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Any, Any]:
        state, info, parts = whole(*primals)
        inputs, structure = jax.tree.flatten((primals[0], primals[2], state.poses))
        dots = jax.tree.leaves((tangents[0], tangents[2], tangents[1].poses), is_leaf=is_constant)
        varying = [i for i, dot in enumerate(dots) if not is_constant(dot)]
        varied = [inputs[i] for i in varying]
        start_dot = tuple(
            jnp.zeros_like(state.x) if is_constant(dot) else dot for dot in (tangents[1].x, tangents[1].v)
        )

        def part(number: Array, varied: list[Array], x: Array, v: Array) -> tuple[Array, Array]:
            replaced = dict(zip(varying, varied, strict=True))
            params, control, poses = structure.unflatten([replaced.get(i, leaf) for i, leaf in enumerate(inputs)])
            known = {"x_after": parts.x_after[number]}
            after, _ = part_of(params, State(x, v, poses=poses), control, parts.length[number], **known)
            return after.x, after.v

        def at(number: Array) -> tuple[list[Array], Array, Array]:
            return varied, parts.x[number], parts.v[number]

        def tangent(number: Array, dots: list[Array], moved: tuple[Array, Array]) -> tuple[Array, Array]:
            return jax.jvp(lambda *values: part(number, *values), at(number), (dots, *moved))[1]

        def cotangent(number: Array, bars: Any) -> tuple[list[Array], Array, Array]:
            return jax.vjp(lambda *values: part(number, *values), *at(number))[1](bars)

        moved = _chain(most, parts.taken, tangent, cotangent, ([dots[i] for i in varying], start_dot))
        factor = jnp.where(info.converged, 1.0, jnp.nan).astype(state.x.dtype)
        state_dot = jax.tree.map(no_tangent, state)._replace(x=factor * moved[0], v=factor * moved[1])
        return (state, info, parts), (state_dot, jax.tree.map(no_tangent, info), jax.tree.map(no_tangent, parts))

    whole.defjvp(derivative, symbolic_zeros=True)

    def step(params: Params, state: State, control: Any = None) -> tuple[State, Info]:
        after, info, _ = whole(params, state, control)
        if state.poses is not None:
            after = after._replace(poses=(jnp.asarray(True), params.poses))
        return after, info

    return step


def _chain(most: int, count: Array, tangent: Callable, cotangent: Callable, inputs: Any) -> tuple[Array, Array]:
    """Returns G (dots, start): the tangent after all parts, from the tangents of their inputs and of the start.

    It is the second half of the solution of [[1, 0], [-G, 1]] (inputs, out) = (inputs, 0): JAX lets callers define the
    transpose of a linear solve, and a loop of unknown length has no transpose of its own.
    """

    def forwards(inputs: Any) -> tuple[Array, Array]:
        dots, start = inputs
        return jax.lax.fori_loop(0, count, lambda number, moved: tangent(number, dots, moved), start)

    def backwards(bars: Any) -> Any:
        def back(place: Array, carry: Any) -> Any:
            collected, bars = carry
            of_dots, *bars = cotangent(count - 1 - place, bars)
            return jax.tree.map(jnp.add, collected, of_dots), tuple(bars)

        return jax.lax.fori_loop(0, count, back, (jax.tree.map(jnp.zeros_like, inputs[0]), bars))

    # One vector, because a solve is transposed only if every part of its right-hand side has a tangent.
    right, parts = ravel_pytree((inputs, jax.tree.map(jnp.zeros_like, inputs[1])))

    def product(both: Array) -> Array:
        # A loop of fixed length can be transposed; only second derivatives evaluate it.
        inputs, out = parts(both)

        def one(moved: Any, number: Array) -> tuple[Any, None]:
            # Empty parts would divide by their length, which is zero.
            return where(number < count, tangent(jnp.minimum(number, count - 1), inputs[0], moved), moved), None

        moved, _ = jax.lax.scan(one, inputs[1], jnp.arange(most))
        return ravel_pytree((inputs, jax.tree.map(jnp.subtract, out, moved)))[0]

    def solve(_: Callable, both: Array) -> Array:
        inputs, out = parts(both)
        return ravel_pytree((inputs, jax.tree.map(jnp.add, out, forwards(inputs))))[0]

    def solve_transposed(_: Callable, both: Array) -> Array:
        inputs, out = parts(both)
        return ravel_pytree((jax.tree.map(jnp.add, inputs, backwards(out)), out))[0]

    return parts(jax.lax.custom_linear_solve(product, right, solve, transpose_solve=solve_transposed))[1]


def _with_part(parts: Parts, state: State, x_after: Array, length: Array, accepted: Array) -> Parts:
    place = jnp.where(accepted, parts.taken, len(parts.length))

    def appended(column: Array, value: Array) -> Array:
        return column.at[place].set(value, mode="drop")

    return Parts(
        x=appended(parts.x, state.x),
        v=appended(parts.v, state.v),
        x_after=appended(parts.x_after, x_after),
        length=appended(parts.length, length),
        taken=parts.taken + accepted,
    )


def _together(first: Info, second: Info) -> Info:
    """Combines the outcomes of two successive parts, except their iterations."""

    def merged(combine: Callable[[Any, Any], Array], name: str) -> Any:
        values = getattr(first, name), getattr(second, name)
        return None if any(value is None for value in values) else combine(*values)

    return second._replace(
        residual=jnp.maximum(first.residual, second.residual),
        definite=merged(jnp.logical_and, "definite"),
        energy_growth=merged(jnp.add, "energy_growth"),
        energy_at_hand=merged(jnp.maximum, "energy_at_hand"),
        least_J=merged(jnp.minimum, "least_J"),
        least_distance=merged(jnp.minimum, "least_distance"),
        friction_change=merged(jnp.maximum, "friction_change"),
        overflow=merged(jnp.logical_or, "overflow"),
    )


def where(condition: Array, new: Any, old: Any) -> Any:
    """Selects one of two trees of arrays."""
    return jax.tree.map(lambda new, old: jnp.where(condition, new, old), new, old)
