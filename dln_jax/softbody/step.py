"""Implicit time steps as minimisations of an incremental potential (Rojas, Sifakis, Kavan 2021; Martin et al. 2011).

    x_{n+1} = argmin_x  1/2 sum m |x - y|² / h² + V(x)

| integrator | h | y | after the minimum x |
|---|---|---|---|
| backward-euler | dt | x_n + h v_n | v_{n+1} = (x - x_n) / dt |
| bdf2 | 2/3 dt | (4 x_n - x_{n-1} + h (4 v_n - v_{n-1})) / 3 | v_{n+1} = (3 x - 4 x_n + x_{n-1}) / (2 dt) |
| midpoint | dt/2 | x_n + h v_n | x is half way: x_{n+1} = 2 x - x_n, v_{n+1} = 2 (x - x_n) / h - v_n |

Backward Euler is of first order and damps; bdf2 is of second order and damps little; the midpoint rule is of second
order and does not damp: use it for smooth motions.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from dln_jax.softbody.mesh.intersections import count_overlaps
from dln_jax.softbody.scene import (
    Params,
    Previous,
    SoftScene,
    State,
    contact_energies,
    element_energies,
    least_distance,
    prepare,
    prepare_contacts,
)
from dln_jax.softbody.verdict import LARGEST_GROWTH, Info, energy_balance, least_J, trusted
from dln_jax.solvers.elements.assembly import Pattern, pattern
from dln_jax.solvers.elements.energies import Corners, ElementEnergy, value
from dln_jax.solvers.elements.linear_solvers import LinearSolverFactory
from dln_jax.solvers.elements.minimise import minimise
from dln_jax.solvers.elements.moving import Lists, lists_between, moving_value
from dln_jax.solvers.elements.selection import by_size, by_stiffness
from dln_jax.solvers.newton import SolverInfo
from dln_jax.types import InputError, require_positive

Step = Callable[[Params, State, Any], tuple[State, Info]]


class Integrator(NamedTuple):
    """An integrator: one line of the table."""

    span: float
    """Time from the state to the minimum, in units of dt."""
    target: Callable[[State, Any], tuple[Any, Array]]
    """(state, dt) -> h, y."""
    finish: Callable[[State, Array, Any], tuple[Array, Array]]
    """(state, x of the minimum, dt) -> x_{n+1}, v_{n+1}."""
    two_steps: bool = False
    """Whether it needs the previous state."""


def _previous(state: State) -> Previous:
    if state.previous is None:
        raise InputError("the state has no room for the state before; make it by the `init` beside this step")
    return state.previous


def _bdf2_target(state: State, dt: Any) -> tuple[Array, Array]:
    x, v, _ = state
    previous = _previous(state)
    h = jnp.where(previous.known, 2 / 3 * dt, dt).astype(x.dtype)
    y = (4 * x - previous.x + h * (4 * v - previous.v)) / 3
    return h, jnp.where(previous.known, y, x + dt * v)


def _bdf2_finish(state: State, x: Array, dt: Any) -> tuple[Array, Array]:
    previous = _previous(state)
    v = (3 * x - 4 * state.x + previous.x) / (2 * dt)
    return x, jnp.where(previous.known, v, (x - state.x) / dt)


BACKWARD_EULER = Integrator(
    span=1.0,
    target=lambda state, dt: (dt, state.x + dt * state.v),
    finish=lambda state, x, dt: (x, (x - state.x) / dt),
)
BDF2 = Integrator(span=1.0, target=_bdf2_target, finish=_bdf2_finish, two_steps=True)
MIDPOINT = Integrator(
    span=0.5,
    target=lambda state, dt: (dt / 2, state.x + dt / 2 * state.v),
    finish=lambda state, x, dt: (2 * x - state.x, 4 / dt * (x - state.x) - state.v),
)
INTEGRATORS = {"backward-euler": BACKWARD_EULER, "bdf2": BDF2, "midpoint": MIDPOINT}
"""Integrators by the names in command lines and tables."""

TOLERANCE = 1e-6
"""Default largest residual force per mass, in m/s²; Newton's last step usually reduces it far below."""


class Stepper(NamedTuple):
    """A time step, and its initial state."""

    init: Callable[..., State]
    """init(x=None, v=None): the rest shape at rest, or positions in m and velocities in m/s, [n, dim] or one [dim]
    for all vertices. `InputError` for a known value that is not finite."""
    step: Step
    """step(params, state, control=None) -> (state after dt, Info): differentiable in all of its arguments."""


def make_step(
    scene: SoftScene,
    dt: Any,
    integrator: Integrator = BACKWARD_EULER,
    *,
    tolerance: float = TOLERANCE,
    iterations: int = 100,
    linear_solver: LinearSolverFactory | None = None,
    definite: bool = False,
) -> Stepper:
    """Returns (init, step) of a scene.

    Args:
        scene: the body; only its own terms are compiled.
        dt: in s; a traced value, whose sign is not checked, serves several steps with one program.
        integrator: `BACKWARD_EULER`, `BDF2`, `MIDPOINT`, or a custom one.
        tolerance: largest residual force per mass, in m/s², of a converged step; rounding errors always count as
            converged.
        iterations: largest number of Newton steps per time step; `Info.converged` reports whether they sufficed.
        linear_solver: solver of the linear systems; by default the one with the least work for the stiffness in
            `scene.params` and this time step (`by_size` if either is traced, or the preparation of a term needs a
            control). Other parameters passed to the step later do not change the choice.
        definite: also report `Info.definite`, at the cost of another Hessian, factorisation and solve in every step.

    Raises:
        InputError: a number that is not positive.
    """
    if not isinstance(dt, Tracer):
        require_positive(dt=dt)
    if scene.contacts and integrator.span != 1.0:
        raise InputError("this integrator extrapolates, which may push bodies through each other; use backward-euler")
    free = scene.free
    energies = (ElementEnergy(_inertia, np.arange(len(free))[:, None], unrolled=True), *element_energies(scene))
    at = pattern(energies, free.shape[0], free.shape[1], free)
    overlaps = None if scene.contacts else count_overlaps(scene.mesh)
    moving = contact_energies(scene)
    rest, masses = scene.params.rest, scene.params.masses
    known = _known(
        (scene.params, dt),
        lambda: ((masses / (integrator.span * dt) ** 2, rest), *prepare(scene, scene.params, rest, dt=dt)),
    )
    chosen = _linear_solver(linear_solver, energies, at, rest, known)
    solve = partial(
        minimise,
        free=free,
        tolerance=tolerance,
        iterations=iterations,
        linear_solver=chosen,
        definite=definite,
        moving=moving,
    )

    def init(x: Any = None, v: Any = None) -> State:
        x, v = scene.mesh.vertices if x is None else x, 0.0 if v is None else v
        for name, values in (("x", x), ("v", v)):
            known = not isinstance(values, Tracer)
            if known and len(wrong := np.argwhere(~np.isfinite(np.broadcast_to(np.asarray(values), free.shape)))):
                raise InputError(f"{name} of vertex {wrong[0][0]} is not finite; expected numbers")
        x, v = (jnp.broadcast_to(jnp.asarray(values, float), free.shape) for values in (x, v))
        return State(x, v, Previous(x, v, jnp.asarray(False)) if integrator.two_steps else None)

    def step(params: Params, state: State, control: Any = None) -> tuple[State, Info]:
        h, target = integrator.target(state, dt)
        span = jnp.asarray(integrator.span * dt, state.x.dtype)
        weights = params.masses / jnp.asarray(h, state.x.dtype) ** 2
        data = ((weights, target), *prepare(scene, params, state.x, dt=span, control=control))
        carried = state.x + span * state.v
        # The better of two starts: the present positions, or those of motion without forces.
        stay, coast = jnp.where(free, state.x, carried), jnp.where(free, target, carried)
        contact = prepare_contacts(scene, params, state.x, dt=span)
        if moving:
            # Only the present positions are known to be apart; held vertices approach their goals from there.
            balanced, outcome = solve(
                energies, stay, data, scale=params.masses, at=at, moving_data=contact, start=state.x
            )
        else:
            start = jnp.where(value(energies, coast, data) < value(energies, stay, data), coast, stay)
            balanced, outcome = solve(energies, start, data, scale=params.masses, at=at)
        x, v = integrator.finish(state, balanced, dt)
        x, v = jnp.where(free, x, state.x + dt * state.v), jnp.where(free, v, state.v)
        info = judged(params, state, x, v, (balanced, outcome, data[1:], contact))
        x, v = trusted((x, v), info.converged)
        before = Previous(state.x, state.v, jnp.asarray(True)) if integrator.two_steps else None
        return State(x, v, before), info

    def judged(params: Params, state: State, x: Array, v: Array, solution: tuple[Array, SolverInfo, Any, Any]) -> Info:
        # The verdict has no derivatives.
        params, state, x, v, solution = jax.lax.stop_gradient((params, state, x, v, solution))
        balanced, outcome, data, contact = solution
        lists = lists_between(moving, state.x, x - state.x, contact)

        def contact_value(x: Array) -> Array:
            return moving_value(moving, x, lists, contact)

        growth, at_hand = energy_balance(
            scene, energies[1:], params.masses, data, (state.x, x), (state.v, v), balanced, outcome, contact_value
        )
        info = _of_positions(scene, params, x, outcome, overlaps, contact, lists)
        return info._replace(
            converged=info.converged & (growth <= LARGEST_GROWTH * at_hand),
            energy_growth=growth,
            energy_at_hand=at_hand,
        )

    return Stepper(init, step)


def positions_and_convergence(state: State, info: Info) -> tuple[Array, Array]:
    """Returns x [n, dim] and whether the step converged, for `rollout`."""
    return state.x, info.converged


def static_solve(
    scene: SoftScene,
    params: Params,
    control: Any = None,
    *,
    x: Any = None,
    tolerance: float = TOLERANCE,
    iterations: int = 200,
    linear_solver: LinearSolverFactory | None = None,
    definite: bool = False,
) -> tuple[Float[Array, "n dim"], Info]:
    """Positions [n, dim] of an equilibrium: a minimum of the potential alone, near the start x (default: rest shape).

    Args:
        scene: the body; without held vertices or springs to the world there is no unique minimum.
        params: of the scene.
        control: actuation, for scenes that have one.
        x: initial positions; held vertices stay there.
        tolerance, iterations, linear_solver, definite: as for `make_step`.
    """
    x = params.rest if x is None else x
    data = prepare(scene, params, x, control=control)
    energies, (count, dimension) = element_energies(scene), scene.mesh.vertices.shape
    at = pattern(energies, count, dimension, scene.free)
    known = _known((params, x, control), lambda: data)
    chosen = _linear_solver(linear_solver, energies, at, x, known)
    solve = partial(minimise, tolerance=tolerance, iterations=iterations, linear_solver=chosen, definite=definite)
    contact = prepare_contacts(scene, params, x)
    solve = partial(solve, moving=contact_energies(scene), moving_data=contact)
    x, outcome = solve(energies, x, data, free=scene.free, scale=params.masses, at=at)
    overlaps = None if scene.contacts else count_overlaps(scene.mesh)
    lists = lists_between(contact_energies(scene), x, jnp.zeros_like(x), contact)
    info = _of_positions(scene, *jax.lax.stop_gradient((params, x, outcome)), overlaps, contact, lists)
    return trusted(x, info.converged), info


def _known(values: Any, data: Callable[[], Any]) -> Any | None:
    """Data of the elements, or `None` if a value is traced or a control is missing."""
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values)):
        return None
    try:
        with jax.ensure_compile_time_eval():
            return data()
    except InputError:
        return None


def _linear_solver(
    requested: LinearSolverFactory | None, energies: Sequence[ElementEnergy], at: Pattern, x: Array, data: Any | None
) -> LinearSolverFactory:
    """Returns the requested linear solver, or the one with the least work, chosen once."""
    if requested is not None:
        return requested
    solver = by_size(energies, at) if data is None else by_stiffness(energies, at, x=x, data=data)
    return lambda *_: solver


def _of_positions(
    scene: SoftScene,
    params: Params,
    x: Array,
    outcome: SolverInfo,
    overlaps: Callable[[Array], Array] | None,
    contact: Sequence[Any],
    lists: Lists,
) -> Info:
    """Combines the solver's verdict with that on the positions: no element is inverted."""
    least = least_J(scene, params, x)
    converged = outcome.converged if least is None else outcome.converged & (least > 0)
    pairs = None if overlaps is None else overlaps(x)
    return Info(
        outcome.residual,
        outcome.iterations,
        converged,
        outcome.definite,
        least_J=least,
        overlaps=pairs,
        least_distance=least_distance(scene, x, lists, contact),
        overflow=outcome.overflow,
    )


def _inertia(x: Corners, weight_and_target: tuple[Array, Array]) -> Float[Array, ""]:
    """½ m/h² |x - y|² of one vertex."""
    weight, target = weight_and_target
    return 0.5 * weight * sum((coordinate - target[i]) ** 2 for i, coordinate in enumerate(x[0]))
