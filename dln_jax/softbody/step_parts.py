"""The parts of an implicit time step: the minimum, the forces there, and the verdict.

A repeated solution of a step lets friction use the normal forces at its end:

    x^(j+1) = argmin E(x; normal forces and directions of friction at x^(j)),    x^(0) = x_n

These are the friction iterations of Li et al. 2020 (Incremental Potential Contact). A fixed point obeys Coulomb's law
with the normal forces at the end of the step. Convergence is not guaranteed, but the error usually falls by a constant
factor per iteration. Every solution warm-starts the next; with constant forces, the next takes no Newton step.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from dln_jax.softbody.integrators import Integrator, averaged, averaged_moving
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
    friction_change,
    trusted,
    verdict_on_energies,
    verdict_on_positions,
    work_of_held,
)
from dln_jax.solvers.elements.assembly import pattern
from dln_jax.solvers.elements.energies import Corners, ElementEnergy, local, value
from dln_jax.solvers.elements.linear_solvers import LinearSolverFactory, known_data, least_work
from dln_jax.solvers.elements.minimise import minimise
from dln_jax.solvers.elements.moving import MovingEnergy, lists_between, moving_gradient
from dln_jax.solvers.newton import SolverInfo
from dln_jax.types import InputError, require_positive


class Problem(NamedTuple):
    """The minimisation of a step: everything known before tracing."""

    scene: SoftScene
    integrator: Integrator
    dt: Any
    """Length of a whole step, in s."""
    energies: tuple[ElementEnergy, ...]
    """Inertia, then the terms, averaged along the step if the integrator averages."""
    moving: tuple[MovingEnergy, ...]
    """Contacts, averaged likewise."""
    minimise: Callable[..., tuple[Array, SolverInfo]]
    """`minimise` for these energies, with the settings of the step."""
    friction_iterations: int
    """Zero without friction."""


class StepData(NamedTuple):
    """Data of one step, with the normal forces of friction at given positions."""

    terms: tuple[Any, ...]
    """Data of the scene's terms."""
    energies: tuple[Any, ...]
    """Data of `Problem.energies`."""
    moving: tuple[Any, ...]
    """Data of `Problem.moving`."""


class Balanced(NamedTuple):
    """Minimum of a step's potential."""

    x: Float[Array, "n dim"]
    """In m."""
    outcome: SolverInfo
    data: StepData
    friction_change: Float[Array, ""] | None = None
    """As in `Info`."""


def step_problem(
    scene: SoftScene,
    dt: Any,
    integrator: Integrator,
    *,
    tolerance: float = TOLERANCE,
    iterations: int = 100,
    linear_solver: LinearSolverFactory | None = None,
    definite: bool = False,
    friction_iterations: int = 1,
) -> Problem:
    """Returns the minimisation in a step; arguments as for `make_step`."""
    if friction_iterations:
        require_positive(friction_iterations=friction_iterations)
    if not isinstance(dt, Tracer):
        require_positive(dt=dt)
    if scene.contacts and integrator.span != 1.0:
        raise InputError(
            "this integrator's steps do not end in a balance of forces, so bodies may pass through each other; "
            "use BACKWARD_EULER, BDF2 or, with obstacles only, AVERAGE_VECTOR_FIELD"
        )
    if integrator.averaged and any(contact.changing for contact in scene.contacts):
        raise InputError(
            "forces between bodies cannot be averaged along the step, because the contact pairs change; "
            "use BACKWARD_EULER or BDF2"
        )
    terms, moving, params = element_energies(scene), contact_energies(scene), scene.params
    if integrator.averaged:
        terms = tuple(averaged(element, scene.mesh.dimension) for element in terms)
        moving = tuple(map(averaged_moving, moving))
    vertices = np.arange(len(scene.free))[:, None]
    energies = (ElementEnergy(_inertia, vertices, unrolled=True), *terms)
    lagged = any(term.lagged for term in scene.terms) or any(contact.friction for contact in scene.contacts)
    problem = Problem(scene, integrator, dt, energies, moving, minimise, friction_iterations if lagged else 0)
    at = pattern(energies, len(scene.free), scene.mesh.dimension, scene.free)
    rest = params.rest
    known = known_data(
        (params, dt),
        lambda: (
            step_data(
                problem,
                params,
                State(rest, jnp.zeros_like(rest)),
                (params.masses / (integrator.span * dt) ** 2, rest),
                dt=dt,
            ).energies
        ),
    )
    solver = (linear_solver or least_work(energies, at, rest, known))(energies, at)
    return problem._replace(
        minimise=partial(
            minimise,
            energies,
            free=scene.free,
            at=at,
            tolerance=tolerance,
            iterations=iterations,
            linear_solver=lambda *_: solver,
            definite=definite,
            moving=moving,
        )
    )


def initial_state(problem: Problem, x: Any = None, v: Any = None) -> State:
    """Returns `Stepper.init(x, v)`."""
    scene = problem.scene
    x, v = scene.mesh.vertices if x is None else x, 0.0 if v is None else v
    for name, values in (("x", x), ("v", v)):
        known = not isinstance(values, Tracer)
        if known and len(wrong := np.argwhere(~np.isfinite(np.broadcast_to(np.asarray(values), scene.free.shape)))):
            raise InputError(f"{name} of vertex {wrong[0][0]} is not finite; expected finite numbers")
    x, v = (jnp.broadcast_to(jnp.asarray(values, float), scene.free.shape) for values in (x, v))
    previous = Previous(x, v, jnp.asarray(False)) if problem.integrator.two_steps else None
    poses = (jnp.asarray(False), scene.params.poses) if scene.params.poses else None
    return State(x, v, previous, Growth(jnp.zeros((), x.dtype), jnp.zeros((), x.dtype)), poses)


def step_data(
    problem: Problem, params: Params, state: State, inertia: tuple[Array, Array], control: Any = None, **settings: Any
) -> StepData:
    """Returns the data of a step with these weights and targets of inertia; settings as for `prepare`."""
    scene = problem.scene
    terms = prepare(scene, params, state.x, control=control, **settings)
    contacts = prepare_contacts(scene, params, state.x, **settings)
    if not problem.integrator.averaged:
        return StepData(terms, (inertia, *terms), contacts)

    def start(name: str) -> Array:
        """Returns the start of the path relative to a surface; its forces are averaged along the path."""
        return state.x + motion_of(name, params.terms[name], settings.get("before"), state.x)

    of_step = zip(scene.terms, element_energies(scene), terms, strict=True)
    names = [contact.name for contact in scene.contacts for _ in contact.energies]
    return StepData(
        terms,
        (inertia, *((local(element, start(term.name)), data) for term, element, data in of_step)),
        tuple((start(name), data) for name, data in zip(names, contacts, strict=True)),
    )


def balance(
    problem: Problem, params: Params, state: State, control: Any, dt: Any, x_after: Array | None = None
) -> Balanced:
    """Returns the minimum of the step; x_after starts the search."""
    integrator, free = problem.integrator, problem.scene.free
    h, target = integrator.target(state, dt)
    span = jnp.asarray(integrator.span * dt, state.x.dtype)
    carried = state.x + span * state.v
    inertia = params.masses / jnp.asarray(h, state.x.dtype) ** 2, target
    before = {}
    if state.poses is not None:
        known, last = state.poses
        share = jnp.asarray(known * integrator.span * dt / problem.dt, span.dtype)
        before = jax.tree.map(lambda now, then: now + share * (then - now), params.poses, last)
    # Averaging along the step halves a linear damping force; half the time restores the force of the mean velocity.
    elapsed = span / 2 if integrator.averaged else span

    def prepared(lag: Array | None) -> StepData:
        return step_data(problem, params, state, inertia, control, dt=elapsed, lag=lag, before=before)

    def solved(x: Array, data: StepData) -> tuple[Array, SolverInfo]:
        # Only known positions are known to be apart; held vertices approach their targets from there.
        start, feasible = jnp.where(free, x, carried), x if problem.moving else None
        return problem.minimise(start, data.energies, scale=params.masses, moving_data=data.moving, start=feasible)

    first = prepared(None)
    if problem.moving:
        start = state.x if x_after is None else x_after
    elif x_after is None:
        # The better of two starts: the current positions, or the positions of a motion without forces.
        stay, coast = jnp.where(free, state.x, carried), jnp.where(free, target, carried)
        energy = jax.vmap(lambda x: value(problem.energies, x, first.energies))
        of_coast, of_stay = energy(jnp.stack([coast, stay]))
        start = jnp.where(of_coast < of_stay, coast, stay)
    else:
        start = jnp.where(free, state.x + integrator.span * (x_after - state.x), carried)
    if problem.friction_iterations:
        # Averaged forces use the normal forces at the middle of the step.
        middle = 0.5 if integrator.averaged else 1.0

        def again(carry: tuple[Array, Any, StepData], _: None) -> tuple[tuple[Array, Any, StepData], SolverInfo]:
            start, _, data = carry
            x, outcome = solved(start, data)
            return (x, data, prepared(state.x + middle * (x - state.x))), outcome

        # The derivative of this loop passes through every minimum, so it is exact even if forces still change.
        begin = start, first, first
        (x, data, at_end), outcomes = jax.lax.scan(again, begin, None, length=problem.friction_iterations + 1)
        outcome = jax.tree.map(lambda values: values[-1], outcomes)._replace(
            iterations=outcomes.iterations.sum(),
            converged=outcomes.converged.all(),
            overflow=None if outcomes.overflow is None else outcomes.overflow.any(),
        )
        change = friction_change(problem.scene, problem.energies, problem.moving, x, data, at_end)
    else:
        x, outcome, data, change = *solved(start, first), first, None
    if problem.friction_iterations or x_after is not None:
        # The search began elsewhere.
        there = lists_between(problem.moving, state.x, jnp.zeros_like(state.x), data.moving)
        outcome = outcome._replace(lists=(there, outcome.lists[1]))
    return Balanced(x, outcome, data, change)


def forces_on_all(problem: Problem, balanced: Balanced) -> Float[Array, "n dim"]:
    """Returns the forces of the energies and of inertia on all vertices, in N: zero on free ones."""
    x, outcome, data, _ = balanced
    slope = jax.grad(lambda x: value(problem.energies, x, data.energies))(x)
    return -slope - moving_gradient(problem.moving, x, outcome.lists[1], data.moving)[1] if problem.moving else -slope


def conclude(problem: Problem, params: Params, state: State, balanced: Balanced, dt: Any) -> tuple[State, Info]:
    """Returns the state after the step, and the verdict."""
    integrator, free = problem.integrator, problem.scene.free
    x, v = integrator.finish(state, balanced.x, dt)
    # If a contact holds back held vertices, moving them to their targets would push them through it.
    x = jnp.where(free, x, balanced.x if problem.moving else state.x + dt * state.v)
    v = jnp.where(free, v, state.v)
    # The verdict has no derivatives.
    info, growth = _verdict(problem, *jax.lax.stop_gradient((params, state, x, v, balanced)))
    x, v = trusted((x, v), info.converged)
    before = Previous(state.x, state.v, jnp.asarray(True)) if integrator.two_steps else None
    poses = None if state.poses is None else (jnp.asarray(True), params.poses)
    return State(x, v, before, growth, poses), info


def _verdict(
    problem: Problem, params: Params, state: State, x: Array, v: Array, balanced: Balanced
) -> tuple[Info, Growth | None]:
    scene, _, _, (_, *terms), moving, _, _ = problem
    at_minimum, outcome, data, friction = balanced
    averages = problem.integrator.averaged
    of_contacts = tuple(own for _, own in data.moving) if averages else data.moving
    work = work_of_held(scene.held, terms, data.energies[1:], at_minimum, x - state.x)
    stored = 0.0
    if moving:
        lists = jax.tree.map(lambda *leaves: jnp.stack(leaves), *outcome.lists)
        touching = contact_energies(scene)
        at_both = jax.vmap(lambda x, lists: moving_gradient(touching, x, lists, of_contacts))
        stored, (_, slope) = at_both(jnp.stack([state.x, x]), lists)
        if averages:
            slope = moving_gradient(moving, at_minimum, outcome.lists[1], data.moving)[1]
        work += jnp.vdot(slope, jnp.where(scene.free, 0, x - state.x))
    info = verdict_on_positions(scene, params, x, outcome, of_contacts)._replace(friction_change=friction)
    both = (state.x, x), (state.v, v)
    return verdict_on_energies(info, state.growth, scene, params.masses, data.terms, *both, work, outcome, stored)


def _inertia(x: Corners, weight_and_target: tuple[Array, Array]) -> Float[Array, ""]:
    """½ m/h² |x - y|² of one vertex."""
    weight, target = weight_and_target
    return 0.5 * weight * sum((coordinate - target[i]) ** 2 for i, coordinate in enumerate(x[0]))
