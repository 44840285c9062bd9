"""Motions of many steps, as one scan that is differentiable from end to end."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from dln_jax.softbody.scene import Params, State
from dln_jax.softbody.step import Step
from dln_jax.solvers.elements.minimise import Info
from dln_jax.types import InputError, require_positive


def positions_and_convergence(state: State, info: Info) -> tuple[Any, Any]:
    """What `rollout` keeps unless told otherwise: x [n, dim] and whether the step converged."""
    return state.x, info.converged


def rollout(
    step: Step,
    state: State,
    params: Params,
    controls: Any = None,
    *,
    steps: int | None = None,
    observe: Callable[[State, Info], Any] = positions_and_convergence,
    segment: int | None = None,
) -> tuple[State, Any]:
    """The state after all steps, and what `observe` sees after each, stacked along a leading axis.

    Args:
        step: of `make_step`, or any (state, params, control) -> (state, Info).
        state: at the start.
        params: of the scene.
        controls: one per step along the leading axis, [steps, ...], or `None` with `steps`.
        steps: how many, where there are no controls.
        observe: (state, info) -> what to keep; what is not kept of `Info` is not computed either.
        segment: steps between the states that reverse mode keeps; the steps between are then computed twice, and memory
            grows with steps / segment + segment. Must divide the number of steps. By default all is kept.

    Raises:
        InputError: neither controls nor steps, or a segment that does not divide them.
    """
    if controls is None and steps is None:
        raise InputError("there are neither controls nor steps; give one of them")
    count = steps if controls is None else jax.tree.leaves(controls)[0].shape[0]
    assert count is not None
    require_positive(steps=count)

    def advance(state: State, control: Any) -> tuple[State, Any]:
        state, info = step(state, params, control)
        return state, observe(state, info)

    if segment is None:
        return jax.lax.scan(advance, state, controls, length=count)
    if segment < 1 or count % segment:
        raise InputError(f"segment is {segment} for {count} steps; expected a divisor of the steps")
    chunked = jax.tree.map(lambda leaf: leaf.reshape(-1, segment, *leaf.shape[1:]), controls)

    @jax.checkpoint
    def advance_segment(state: State, controls: Any) -> tuple[State, Any]:
        return jax.lax.scan(advance, state, controls, length=segment)

    last, seen = jax.lax.scan(advance_segment, state, chunked, length=count // segment)
    return last, jax.tree.map(lambda leaf: jnp.reshape(leaf, (count, *leaf.shape[2:])), seen)
