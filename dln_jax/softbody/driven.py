"""Driven motions: actuated muscles, and held vertices that follow a path.

Paths are followed exactly: in every step a held vertex has the velocity (p(t + dt) - p(t)) / dt. With the path's
velocity at t instead, a rotation would spiral outwards.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.softbody.integrators import BACKWARD_EULER, Integrator
from dln_jax.softbody.scene import Params, SoftScene, State
from dln_jax.softbody.step import Stepper, make_step
from dln_jax.softbody.verdict import Info


class Example(NamedTuple):
    """A scene with its initial velocities and its drive."""

    scene: SoftScene
    dt: float
    """Suitable time step in s."""
    seconds: float
    """Duration of an illustrative motion in s."""
    v: Any = 0.0
    """Initial velocities in m/s, [n, dim] or one for all; the body starts in its rest shape."""
    ground: float | None = None
    """Slope of the ground (rise over run), which passes through the origin; `None` without ground."""
    control: Callable[[np.ndarray], Any] | None = None
    """Times [T] in s -> actuation [T, k], or a dict of such arrays by actuator."""
    held_path: Callable[[np.ndarray], np.ndarray] | None = None
    """Times [T] in s -> positions of the held vertices [T, k, dim]; by default they stay."""
    muscles: np.ndarray | None = None
    """Pairs of vertices [k, 2], for figures."""
    moments: tuple[float, ...] = (0.0,)
    """Times in s that figures show."""


class Drive(NamedTuple):
    """Inputs of one step; several steps add a leading axis."""

    t: Float[Array, "*steps"]
    """Time at the end of the step, in s."""
    control: Any
    """Actuation [k] at the end of the step, or a dict of such arrays; `None` without actuators."""
    held_velocity: Float[Array, "*steps k dim"] | None
    """Velocities of the held vertices, in m/s."""


def drive(example: Example, dt: float, steps: int, *, first: int = 0) -> Drive:
    """Returns inputs of `steps` steps of dt in s from step `first` on, with held velocities that follow their paths."""
    t = dt * np.arange(first, first + steps + 1)
    dtype = example.scene.params.rest.dtype
    control = (
        None if example.control is None else jax.tree.map(lambda of: jnp.asarray(of, dtype), example.control(t[1:]))
    )
    velocity = None if example.held_path is None else jnp.asarray(np.diff(example.held_path(t), axis=0) / dt, dtype)
    return Drive(jnp.asarray(t[1:], dtype), control, velocity)


def driven_step(example: Example, dt: float, integrator: Integrator = BACKWARD_EULER, *, halvings: int = 0) -> Stepper:
    """Returns (init, step): init() is the example's initial state, and step(params, state, Drive) -> (state, Info)."""
    init, step = make_step(example.scene, dt, integrator, halvings=halvings)

    def advance(params: Params, state: State, driven: Drive) -> tuple[State, Info]:
        if driven.held_velocity is not None:
            state = state._replace(v=state.v.at[example.scene.held].set(driven.held_velocity))
        return step(params, state, driven.control)

    return Stepper(functools.partial(init, v=example.v), advance)
