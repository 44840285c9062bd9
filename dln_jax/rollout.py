"""Many steps as one scan, differentiable from end to end."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from dln_jax.types import InputError, require_positive


def rollout(
    step: Callable[[Any, Any], tuple[Any, Any]],
    state: Any,
    inputs: Any = None,
    *,
    steps: int | None = None,
    observe: Callable[[Any, Any], Any] = lambda state, info: state,
    segment: int | None = None,
) -> tuple[Any, Any]:
    """Advances a state by many steps; returns the last state and the observations of all steps, [steps, ...].

    Args:
        step: (state, input) -> (state, info); parameters are closed over, as by `functools.partial(step, params)`.
        state: initial state; any tree of arrays. A step must keep their shapes and types.
        inputs: one input per step on the leading axis, [steps, ...]; or `None`, and give `steps`.
        steps: number of steps, if there are no inputs.
        observe: (state, info) -> values to keep, by default the state; unused parts of `info` are not computed.
        segment: reverse mode stores one state every `segment` steps and recomputes the others, so memory grows with
            steps / segment + segment. Must divide the number of steps. By default every state is stored.

    Raises:
        InputError: neither inputs nor steps, or a segment that does not divide the number of steps.
    """
    leaves = jax.tree.leaves(inputs)
    count = leaves[0].shape[0] if leaves else steps
    if count is None:
        raise InputError("neither inputs nor steps were given; give one of them")
    if not leaves:
        require_positive(steps=count)

    def advance(state: Any, input: Any) -> tuple[Any, Any]:
        state, info = step(state, input)
        return state, observe(state, info)

    if segment is None:
        return jax.lax.scan(advance, state, inputs, length=count)
    if segment < 1 or count % segment:
        raise InputError(f"segment is {segment} for {count} steps; expected a divisor of the steps")
    chunked = jax.tree.map(lambda leaf: leaf.reshape(-1, segment, *leaf.shape[1:]), inputs)

    @jax.checkpoint
    def advance_segment(state: Any, chunk: Any) -> tuple[Any, Any]:
        return jax.lax.scan(advance, state, chunk, length=segment)

    last, seen = jax.lax.scan(advance_segment, state, chunked, length=count // segment)
    return last, jax.tree.map(lambda leaf: jnp.reshape(leaf, (count, *leaf.shape[2:])), seen)
