"""The parts of an implicit time step: the minimum, the forces there, and the verdict."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from dln_jax.softbody.friction_iterations import friction_change, has_friction, iterated
from dln_jax.softbody.integrators import BACKWARD_EULER, Integrator, averaged, averaged_data, averaged_moving
from dln_jax.softbody.scene import (
    Growth,
    Params,
    Previous,
    SoftScene,
    State,
    contact_energies,
    element_energies,
    prepare,
    prepare_contacts,
)
from dln_jax.softbody.terms.contact import motion_of
from dln_jax.softbody.verdict import (
    TOLERANCE,
    Info,
    energy_balance,
    trusted,
    verdict_on_positions,
    with_energies,
    work_of_held,
)
from dln_jax.solvers.elements.assembly import pattern
from dln_jax.solvers.elements.energies import Corners, ElementEnergy, value
from dln_jax.solvers.elements.linear_solvers import LinearSolverFactory
from dln_jax.solvers.elements.minimise import minimise
from dln_jax.solvers.elements.moving import lists_between, moving_gradient
from dln_jax.solvers.elements.selection import known_data, least_work
from dln_jax.solvers.newton import SolverInfo
from dln_jax.types import InputError, require_positive


class Balanced(NamedTuple):
    """Minimum of a step's potential."""

    x: Float[Array, "n dim"]
    """In m."""
    outcome: SolverInfo
    at_start: tuple[Any, ...]
    """Data of the scene's terms."""
    data: tuple[Any, ...]
    """Data of the step's energies: of inertia, then of the terms, averaged if the integrator averages."""
    contact: tuple[Any, ...]
    """Data of the contacts."""
    friction_change: Float[Array, ""] | None = None
    """As in `Info`."""


class StepParts(NamedTuple):
    """A time step in two parts, for callers that also solve for the motion of held vertices."""

    init: Callable[..., State]
    balance: Callable[..., Balanced]
    """balance(params, state, control, dt, x_after=None): x_after starts the search."""
    forces: Callable[[Balanced], Float[Array, "n dim"]]
    """Forces of the energies and of inertia on all vertices, in N: zero on free ones."""
    conclude: Callable[..., tuple[State, Info]]
    """conclude(params, state, balanced, dt): the state after the step, and the verdict."""


def step_parts(
    scene: SoftScene,
    dt: Any,
    integrator: Integrator = BACKWARD_EULER,
    tolerance: float = TOLERANCE,
    iterations: int = 100,
    *,
    linear_solver: LinearSolverFactory | None = None,
    definite: bool = False,
    friction_iterations: int = 1,
) -> StepParts:
    """Returns the parts of the step that `make_step` returns; arguments are explained there."""
    if friction_iterations:
        require_positive(friction_iterations=friction_iterations)
    if not isinstance(dt, Tracer):
        require_positive(dt=dt)
    if scene.contacts and integrator.span != 1.0:
        raise InputError(
            "this integrator does not end where forces balance, which may push bodies through each other; "
            "use BACKWARD_EULER, BDF2 or, with obstacles only, AVERAGE_VECTOR_FIELD"
        )
    if integrator.averaged and any(contact.changing for contact in scene.contacts):
        raise InputError(
            "forces between bodies cannot be averaged along the step, because the pairs that touch change; "
            "use BACKWARD_EULER or BDF2"
        )
    free, whole = scene.free, dt
    terms = stored = element_energies(scene)
    if integrator.averaged:
        terms = tuple(averaged(element, scene.mesh.dimension) for element in stored)
    energies = (ElementEnergy(_inertia, np.arange(len(free))[:, None], unrolled=True), *terms)
    at = pattern(energies, free.shape[0], free.shape[1], free)
    touching = contact_energies(scene)
    touched = [contact.name for contact in scene.contacts for _ in contact.energies]
    moving = tuple(map(averaged_moving, touching)) if integrator.averaged else touching
    iterating = friction_iterations > 0 and has_friction(scene)
    rest, masses = scene.params.rest, scene.params.masses

    def along(start: Callable[[str], Array], data: tuple[Any, ...]) -> tuple[Any, ...]:
        """Returns the data of the terms, averaged along the step if the integrator averages."""
        if not integrator.averaged:
            return data
        starts = [start(term.name) for term in scene.terms]
        return tuple(map(averaged_data, stored, starts, data))

    known = known_data(
        (scene.params, dt),
        lambda: (
            (masses / (integrator.span * dt) ** 2, rest),
            *along(lambda _: rest, prepare(scene, scene.params, rest, dt=dt)),
        ),
    )
    solver = (linear_solver or least_work(energies, at, rest, known))(energies, at)
    solve = partial(
        minimise,
        free=free,
        tolerance=tolerance,
        iterations=iterations,
        linear_solver=lambda *_: solver,
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
        previous = Previous(x, v, jnp.asarray(False)) if integrator.two_steps else None
        poses = (jnp.asarray(False), scene.params.poses) if scene.params.poses else None
        return State(x, v, previous, Growth(jnp.zeros((), x.dtype), jnp.zeros((), x.dtype)), poses)

    def balance(params: Params, state: State, control: Any, dt: Any, x_after: Array | None = None) -> Balanced:
        h, target = integrator.target(state, dt)
        span = jnp.asarray(integrator.span * dt, state.x.dtype)
        weights = params.masses / jnp.asarray(h, state.x.dtype) ** 2
        # Averaging along the step halves a linear damping force; half the time makes it that of the mean velocity.
        elapsed = span / 2 if integrator.averaged else span
        before = {}
        if state.poses is not None:
            known, last = state.poses
            share = jnp.asarray(known * integrator.span * dt / whole, span.dtype)
            before = jax.tree.map(lambda now, then: now + share * (then - now), params.poses, last)

        def begun(name: str) -> Array:
            """Returns the start of the way relative to a surface, along which its forces are averaged."""
            return state.x + motion_of(name, params.terms[name], before, state.x)

        def prepared(lag: Array | None) -> tuple[Any, Any, Any]:
            at_start = prepare(scene, params, state.x, dt=elapsed, control=control, lag=lag, before=before)
            contact = prepare_contacts(scene, params, state.x, dt=elapsed, lag=lag, before=before)
            contact = tuple(zip(map(begun, touched), contact, strict=True)) if integrator.averaged else contact
            return at_start, ((weights, target), *along(begun, at_start)), contact

        first = prepared(None)
        data = first[1]
        carried = state.x + span * state.v
        if moving:
            start = state.x if x_after is None else x_after
        elif x_after is None:
            # The better of two starts: the current positions, or those of a motion without forces.
            stay, coast = jnp.where(free, state.x, carried), jnp.where(free, target, carried)
            of_coast, of_stay = jax.vmap(lambda x: value(energies, x, data))(jnp.stack([coast, stay]))
            start = jnp.where(of_coast < of_stay, coast, stay)
        else:
            start = jnp.where(free, state.x + integrator.span * (x_after - state.x), carried)

        def from_start(outcome: SolverInfo, contact: Any) -> SolverInfo:
            """Returns the outcome with the lists at the start of the step, if the search began elsewhere."""
            there = lists_between(moving, state.x, jnp.zeros_like(state.x), contact)
            return outcome._replace(lists=(there, outcome.lists[1]))

        def solved(x: Array, parts: tuple[Any, Any, Any]) -> tuple[Array, SolverInfo]:
            _, data, contact = parts
            # Only known positions are known to be apart; held vertices approach their targets from there.
            start, feasible = jnp.where(free, x, carried), x if moving else None
            return solve(energies, start, data, scale=params.masses, at=at, moving_data=contact, start=feasible)

        if not iterating:
            x, outcome = solved(start, first)
            return Balanced(x, outcome if x_after is None else from_start(outcome, first[2]), *first)
        # Forces averaged along the step take the normal forces at its middle.
        middle = 0.5 if integrator.averaged else 1.0
        x, outcome, (at_start, data, contact), (_, at_end, contact_at_end) = iterated(
            solved, lambda x: prepared(state.x + middle * (x - state.x)), start, first, friction_iterations
        )
        change = friction_change(scene, terms, moving, x, (data[1:], contact), (at_end[1:], contact_at_end))
        return Balanced(x, from_start(outcome, contact), at_start, data, contact, change)

    def forces(balanced: Balanced) -> Float[Array, "n dim"]:
        x, outcome, _, data, contact, _ = balanced
        slope = jax.grad(lambda x: value(energies, x, data))(x)
        return -slope - moving_gradient(moving, x, outcome.lists[1], contact)[1] if moving else -slope

    def conclude(params: Params, state: State, balanced: Balanced, dt: Any) -> tuple[State, Info]:
        x, v = integrator.finish(state, balanced.x, dt)
        # If a contact keeps held vertices from their targets, moving them there would push them through it.
        x = jnp.where(free, x, balanced.x if moving else state.x + dt * state.v)
        v = jnp.where(free, v, state.v)
        info, growth = judged(params, state, x, v, balanced)
        x, v = trusted((x, v), info.converged)
        before = Previous(state.x, state.v, jnp.asarray(True)) if integrator.two_steps else None
        poses = None if state.poses is None else (jnp.asarray(True), params.poses)
        return State(x, v, before, growth, poses), info

    def judged(params: Params, state: State, x: Array, v: Array, solution: Balanced) -> tuple[Info, Growth | None]:
        # The verdict has no derivatives.
        params, state, x, v, solution = jax.lax.stop_gradient((params, state, x, v, solution))
        balanced, outcome, at_start, (_, *data), contact, friction = solution
        of_stored = tuple(of for _, of in contact) if integrator.averaged else contact
        work, stored = work_of_held(scene.held, terms, data, balanced, x - state.x), 0.0
        if moving:
            lists = jax.tree.map(lambda *leaves: jnp.stack(leaves), *outcome.lists)
            at_both = jax.vmap(lambda x, lists: moving_gradient(touching, x, lists, of_stored))
            stored, (_, slope) = at_both(jnp.stack([state.x, x]), lists)
            if integrator.averaged:
                slope = moving_gradient(moving, balanced, outcome.lists[1], contact)[1]
            work += jnp.vdot(slope, jnp.where(free, 0, x - state.x))
        energies_of_step = energy_balance(
            scene, params.masses, at_start, (state.x, x), (state.v, v), work, outcome, stored
        )
        info = verdict_on_positions(scene, params, x, outcome, of_stored)._replace(friction_change=friction)
        return with_energies(info, energies_of_step, state.growth)

    return StepParts(init, balance, forces, conclude)


def _inertia(x: Corners, weight_and_target: tuple[Array, Array]) -> Float[Array, ""]:
    """½ m/h² |x - y|² of one vertex."""
    weight, target = weight_and_target
    return 0.5 * weight * sum((coordinate - target[i]) ** 2 for i, coordinate in enumerate(x[0]))
