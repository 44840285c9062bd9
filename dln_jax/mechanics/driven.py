"""Motions under recorded torques: samples of a function of time, held or interpolated."""

from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dln_jax.mechanics.integrators import Field, State, Step, advance, rk4
from dln_jax.rollout import rollout
from dln_jax.types import InputError

Torque = Literal["held", "interpolated"]


def torque_slopes(tau: Float[Array, "T d"], t: Float[Array, " T"], torque: Torque) -> Float[Array, "T-1 d"]:
    """Rates of the torque within the intervals; zero if it is held, and for intervals of length zero.

    Raises:
        InputError: a `torque` of another name.
    """
    if torque not in ("held", "interpolated"):
        raise InputError(f"torque is {torque!r}; expected 'held' or 'interpolated'")
    changes = jnp.diff(tau, axis=0)
    if torque == "held":
        return jnp.zeros_like(changes)
    durations = jnp.diff(t)[:, None]
    return jnp.where(durations > 0, changes / jnp.where(durations > 0, durations, 1.0), 0.0)


def driven(
    rate: Callable[[Any, Array], Any],
    start: State,
    tau: Array,
    slopes: Array,
    durations: Array,
    *,
    substeps: int,
    method: Callable[[Field], Step] = rk4,
) -> State:
    """Integrates y' = rate(y, tau(t)) by RK4 and returns the states at the samples; leaves get a leading axis T.

    Args:
        rate: (state, tau) -> rate of the state.
        start: state at the first sample.
        tau: [T - 1, d], torque at the start of every interval; within it the torque is tau + slopes s.
        slopes: [T - 1, d], from `torque_slopes`.
        durations: [T - 1] in s; over a duration of zero the state stays.
        substeps: per interval.
        method: field -> step; `looped_rk4` compiles faster.
    """

    def interval(state: State, drive: tuple[Array, Array, Array]) -> tuple[State, None]:
        tau, slope, duration = drive
        step = method(lambda s, state: rate(state, tau + s * slope))
        return advance(step, jnp.zeros_like(duration), state, duration, substeps=substeps), None

    _, later = rollout(interval, start, (tau, slopes, durations))
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, later)


def looped_rk4(field: Field) -> Step:
    """`rk4` with its stages in a loop: the field is in the program once instead of four times.

    For fits through an integrator and motions that run once, where compilation takes longer than execution.
    """
    nodes, weights = jnp.array([0.0, 0.5, 0.5, 1.0]), jnp.array([1.0, 2.0, 2.0, 1.0]) / 6

    def step(t: Any, state: State, dt: Any) -> State:
        def stage(carry: tuple[State, State], coefficients: tuple[Array, Array]) -> tuple[tuple[State, State], None]:
            rate, total = carry
            node, weight = coefficients
            at = jax.tree.map(lambda value, slope: value + node * dt * slope, state, rate)
            rate = field(t + node * dt, at)
            return (rate, jax.tree.map(lambda sum_, slope: sum_ + weight * dt * slope, total, rate)), None

        still = jax.tree.map(jnp.zeros_like, state)
        coefficients = (nodes.astype(jnp.result_type(dt)), weights.astype(jnp.result_type(dt)))
        return jax.lax.scan(stage, (still, state), coefficients)[0][1]

    return step
