"""Implicit time steps as minimisations of an incremental potential (Rojas, Sifakis, Kavan 2021; Martin et al. 2011).

    x_{n+1} = argmin_x  1/2 sum m |x - y|² / h² + V(x)

| integrator | h | y | after the minimum x |
|---|---|---|---|
| backward-euler | dt | x_n + h v_n | v_{n+1} = (x - x_n) / dt |
| bdf2 | 2/3 dt | (4 x_n - x_{n-1} + h (4 v_n - v_{n-1})) / 3 | v_{n+1} = (3 x - 4 x_n + x_{n-1}) / (2 dt) |
| midpoint | dt/2 | x_n + h v_n | x is half way: x_{n+1} = 2 x - x_n, v_{n+1} = 2 (x - x_n) / h - v_n |

Backward Euler is of first order and damps; bdf2 is of second order and damps little; the midpoint rule is of second
order and does not damp, so that it is for smooth motions.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, get_args

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from dln_jax.softbody.scene import Params, Previous, SoftScene, State, element_energies, prepare
from dln_jax.softbody.terms.term import Context
from dln_jax.solvers.elements.element_energies import Corners, ElementEnergy, pattern, value
from dln_jax.solvers.elements.linear_solvers import LinearSolverFactory, by_size
from dln_jax.solvers.elements.minimise import Info, minimise
from dln_jax.types import InputError, require_positive

Integrator = Literal["backward-euler", "bdf2", "midpoint"]
Step = Callable[[State, Params, Any], tuple[State, Info]]

TOLERANCE = 1e-6
"""Default largest force that is left over, per mass, in m/s²; Newton's last step usually takes it far below."""


class _Inertia(NamedTuple):
    weight: Float[Array, " n"]
    """m / h² in N/m."""
    target: Float[Array, "n dim"]
    """y in m."""


def incremental_potential(scene: SoftScene) -> tuple[ElementEnergy, ...]:
    """Inertia and the scene's terms, as energies whose data are an inertia's and the terms'."""
    return (
        ElementEnergy(_inertia, np.arange(len(scene.mesh.vertices))[:, None], written_out=True),
        *element_energies(scene),
    )


def make_step(
    scene: SoftScene,
    dt: Any,
    integrator: Integrator | str = "backward-euler",
    *,
    tolerance: float = TOLERANCE,
    iterations: int = 100,
    linear_solver: LinearSolverFactory = by_size,
) -> Step:
    """step(state, params, control) -> (state after dt, Info): differentiable in all of its arguments.

    Args:
        scene: the body; its terms are compiled, no others.
        dt: in s; a traced value, whose sign is not checked, serves several steps by one program.
        integrator: "backward-euler", "bdf2" or "midpoint".
        tolerance: largest force left over per mass, in m/s², that counts as balanced; rounding always does.
        iterations: Newton steps after which a time step gives up, which `Info.converged` reports.
        linear_solver: how linear systems are solved; by size unless said.

    Raises:
        InputError: an unknown integrator or a number that is not positive; a step of "bdf2" also for a state without
            room for the state before.
    """
    if not isinstance(dt, Tracer):
        require_positive(dt=dt)
    if integrator not in get_args(Integrator):
        raise InputError(f"integrator '{integrator}' is unknown; choose from {', '.join(get_args(Integrator))}")
    energies = incremental_potential(scene)
    free = scene.free
    at = pattern(energies, free.shape[0], free.shape[1], free)

    def step(state: State, params: Params, control: Any = None) -> tuple[State, Info]:
        length, target = _inertial_target(state, dt, integrator)
        span = _span(dt, integrator, state)
        context = Context(params.rest, params.masses, state.x, state.v, span, control)
        inertia = _Inertia(params.masses / length**2, target)
        data = (inertia, *prepare(scene, params, context))
        carried = state.x + span * state.v
        start = _better(energies, data, jnp.where(free, state.x, carried), jnp.where(free, target, carried))
        x, info = minimise(
            energies,
            start,
            data,
            free=free,
            scale=params.masses,
            tolerance=tolerance,
            iterations=iterations,
            linear_solver=linear_solver,
            at=at,
        )
        return _advance(state, x, dt, integrator, free), info

    return step


def static_solve(
    scene: SoftScene,
    params: Params,
    control: Any = None,
    *,
    x: Any = None,
    tolerance: float = TOLERANCE,
    iterations: int = 200,
    linear_solver: LinearSolverFactory = by_size,
) -> tuple[Float[Array, "n dim"], Info]:
    """Positions [n, dim] of an equilibrium: a minimum of the potential alone, near the start x (default: rest shape).

    Args:
        scene: the body; without held vertices or springs to the world there is no single minimum.
        params: of the scene.
        control: actuation, for scenes that have one.
        x: where the search starts; held vertices stay there.
        tolerance: largest force left over per mass, in m/s²; rounding always counts as balanced.
        iterations: Newton steps after which the search gives up, which `Info.converged` reports.
        linear_solver: how linear systems are solved; by size unless said.
    """
    x = params.rest if x is None else x
    context = Context(params.rest, params.masses, x, jnp.zeros_like(x), jnp.asarray(jnp.inf, x.dtype), control)
    return minimise(
        element_energies(scene),
        x,
        prepare(scene, params, context),
        free=scene.free,
        scale=params.masses,
        tolerance=tolerance,
        iterations=iterations,
        linear_solver=linear_solver,
    )


def _inertia(x: Corners, data: _Inertia) -> Float[Array, ""]:
    return 0.5 * data.weight * sum((coordinate - data.target[i]) ** 2 for i, coordinate in enumerate(x[0]))


def _inertial_target(state: State, dt: Any, integrator: str) -> tuple[Array, Array]:
    """(h, y) of the minimisation."""
    x, v = state.x, state.v
    if integrator == "midpoint":
        return jnp.asarray(dt / 2, x.dtype), x + dt / 2 * v
    if integrator == "backward-euler":
        return jnp.asarray(dt, x.dtype), x + dt * v
    if (previous := state.previous) is None:
        raise InputError("the state has no room for the state before; make it by initial_state(..., two_steps=True)")
    length = jnp.where(previous.known, 2 / 3 * dt, dt).astype(x.dtype)
    two_steps = (4 * x - previous.x + length * (4 * v - previous.v)) / 3
    return length, jnp.where(previous.known, two_steps, x + dt * v)


def _span(dt: Any, integrator: str, state: State) -> Array:
    """Time in s from the state to the minimum."""
    return jnp.asarray(dt / 2 if integrator == "midpoint" else dt, state.x.dtype)


def _better(energies: tuple[ElementEnergy, ...], data: tuple[Any, ...], stay: Array, coast: Array) -> Array:
    """The better start of the two: where the body is, or where it would be without forces."""
    lower = value(energies, coast, data) < value(energies, stay, data)
    return jnp.where(lower, coast, stay)


def _advance(state: State, x: Array, dt: Any, integrator: str, free: np.ndarray) -> State:
    before = state.previous
    if integrator == "midpoint":
        after, v = 2 * x - state.x, 4 / dt * (x - state.x) - state.v
    elif before is None or integrator == "backward-euler":
        after, v = x, (x - state.x) / dt
    else:
        two_steps = (3 * x - 4 * state.x + before.x) / (2 * dt)
        after, v = x, jnp.where(before.known, two_steps, (x - state.x) / dt)
    moved = state._replace(x=jnp.where(free, after, state.x + dt * state.v), v=jnp.where(free, v, state.v))
    if before is None:
        return moved
    return moved._replace(previous=Previous(state.x, state.v, jnp.asarray(True)))
