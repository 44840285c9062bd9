"""Soft bodies carried by a robot: vertices are tied to frames that move with the joints, which feel the forces.

    tau + sum over ties Jᵀ f = M(q) qdd + c(q, qd) + g(q),    x_tied = R(q) X + p(q),    f = -dE/dx_tied

E is the incremental potential of the soft body's step (its energies and inertia), minimised over the free vertices, so
f includes the weight and the inertia of the tied vertices. Both equations hold at the end of the step: the joint
positions are the root of the first one, found by Newton's method around the minimisation. Its Jacobian, the added
stiffness and mass of the soft body, comes from the implicit function theorem. The coupled step is therefore stable
whichever is heavier or stiffer.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from dln_jax.softbody.integrators import BACKWARD_EULER, Integrator
from dln_jax.softbody.mesh.mesh import components_of_vertices, indices_of
from dln_jax.softbody.scene import Params, Previous, SoftScene, State
from dln_jax.softbody.step_parts import Balanced, step_parts
from dln_jax.softbody.verdict import Info, trusted
from dln_jax.solvers.newton import find_root
from dln_jax.types import InputError, Vector, require_positive

Pose = Callable[[Vector], tuple[Float[Array, "dim dim"], Float[Array, " dim"]]]
"""q [d] -> rotation R and origin p in m of a frame in the world."""
REACHED = 1e-9
"""Largest distance of a tied vertex from its place in the frame, relative to the extent of the body. A vertex that
contact holds back is farther away."""


class Tie(NamedTuple):
    """Vertices fixed in a frame; the rest shape gives their coordinates in it."""

    pose: Pose
    vertices: Int[np.ndarray, " k"]


class TiedState(NamedTuple):
    """State of a robot and of the soft bodies that it carries."""

    robot: State
    """x is q [d] in rad or m, v is qd [d]."""
    body: State


class TiedStepper(NamedTuple):
    """A coupled time step and its initial state."""

    init: Callable[..., TiedState]
    step: Callable[[Params, TiedState, tuple[Any, Any]], tuple[TiedState, Info]]


def make_tied_step(
    scene: SoftScene,
    dt: float,
    ties: Sequence[Tie],
    inverse_dynamics: Callable[[Vector, Vector, Vector], Vector],
    integrator: Integrator = BACKWARD_EULER,
    *,
    torque_tolerance: float = 1e-6,
    joint_iterations: int = 20,
    **settings: Any,
) -> TiedStepper:
    """Returns (init, step) of a robot that carries the soft bodies of a scene.

    init(q, qd=0, x=None, v=None) -> TiedState. By default every component of the mesh with a tie is moved rigidly from
    its rest shape into the frame of its first tie; the others stay in their rest shape.
    step(params, state, (tau, control)) -> (TiedState, Info of the soft bodies) is differentiable in all its arguments.
    tau [d] are the generalised forces of the joints at the end of the step, and control is the scene's (or `None`).
    `Info.converged` also requires that the joints' equations hold and that no contact keeps a tied vertex from its
    frame. Each step takes one minimisation per iteration on q (2 or 3) and a final one.

    Args:
        scene: its `held` must contain the tied vertices; other held vertices keep their velocity, as in `make_step`.
        dt: in s.
        inverse_dynamics: (q, qd, qdd) -> tau of the robot alone, from a known tree or a learned model.
        integrator: `BACKWARD_EULER` or `BDF2`, for robot and bodies.
        torque_tolerance: largest residual of the joints' equations, in N m (or N).
        joint_iterations: largest number of Newton iterations on q.
        settings: tolerance, iterations, linear_solver and definite of `make_step`.

    Raises:
        InputError: the integrator does not end where forces balance, there is no tie, a vertex is free or tied twice.
    """
    require_positive(dt=dt, torque_tolerance=torque_tolerance, joint_iterations=joint_iterations)
    if integrator.span != 1.0 or integrator.averaged:
        raise InputError("tied steps need an integrator that ends where forces balance: BACKWARD_EULER or BDF2")
    ties, frame_of = _checked(scene, ties)
    tied = np.concatenate([tie.vertices for tie in ties])
    soft_init, balance, forces, conclude = step_parts(scene, dt, integrator, **settings)
    reached = REACHED * float(np.ptp(scene.mesh.vertices, axis=0).max())

    def positions(rest: Array, q: Vector) -> Float[Array, "k dim"]:
        return jnp.concatenate([_moved(tie.pose(q), rest[tie.vertices]) for tie in ties])

    def init(q: Any, qd: Any = 0.0, x: Any = None, v: Any = None) -> TiedState:
        q = jnp.asarray(q, float)
        robot = _first_state(integrator, q, jnp.broadcast_to(jnp.asarray(qd, float), q.shape))

        def carried(q: Vector) -> Array:
            placed = jnp.asarray(scene.mesh.vertices)
            for tie, vertices in zip(ties, frame_of, strict=True):
                placed = placed.at[vertices].set(_moved(tie.pose(q), scene.params.rest[vertices]))
            return placed

        x_carried, v_carried = jax.jvp(carried, (q,), (robot.v,))
        body = soft_init(x_carried if x is None else x, v_carried if v is None else v)
        at_ties = positions(scene.params.rest, q)
        return TiedState(robot, body._replace(x=body.x.at[tied].set(at_ties)))

    def soft(params: Params, body: State, q: Vector, control: Any) -> tuple[State, Balanced]:
        velocity = (positions(params.rest, q) - body.x[tied]) / dt
        moved = body._replace(v=body.v.at[tied].set(velocity))
        balanced = balance(params, moved, control, dt)
        # The inertia of the tied vertices is relative to their motion before the step.
        (weights, _), *others = balanced.data
        return moved, balanced._replace(data=((weights, integrator.target(body, dt)[1]), *others))

    def residual(q: Vector, params: Params, state: TiedState, tau: Vector, control: Any) -> Vector:
        h, target = integrator.target(state.robot, dt)
        _, qd = integrator.finish(state.robot, q, dt)
        _, balanced = soft(params, state.body, q, control)
        back = jax.vjp(partial(positions, params.rest), q)[1](forces(balanced)[tied])[0]
        return inverse_dynamics(q, qd, (q - target) / h**2) - tau - back

    def step(params: Params, state: TiedState, inputs: tuple[Any, Any]) -> tuple[TiedState, Info]:
        tau, control = inputs
        robot = state.robot
        q, outcome = find_root(
            residual,
            robot.x + dt * robot.v,
            params,
            state,
            jnp.asarray(tau, robot.x.dtype),
            control,
            tolerance=torque_tolerance,
            iterations=joint_iterations,
        )
        body, info = conclude(params, *soft(params, state.body, q, control), dt)
        missed = jnp.max(jnp.abs(body.x[tied] - positions(params.rest, q)))
        # Tied vertices move with the body: their velocity is the integrator's, not that of a straight line.
        v = integrator.finish(state.body, body.x, dt)[1][tied]
        body = body._replace(v=body.v.at[tied].set(v))
        if integrator.two_steps:
            body = body._replace(previous=Previous(state.body.x, state.body.v, jnp.asarray(True)))
        converged = info.converged & outcome.converged & (missed <= reached)
        before = Previous(robot.x, robot.v, jnp.asarray(True)) if integrator.two_steps else None
        q, qd = trusted(integrator.finish(robot, q, dt), converged)
        return TiedState(State(q, qd, before), body), info._replace(converged=converged)

    return TiedStepper(init, step)


def _first_state(integrator: Integrator, x: Array, v: Array) -> State:
    """Returns an initial state, with room for the previous one in two-step methods."""
    return State(x, v, Previous(x, v, jnp.asarray(False)) if integrator.two_steps else None)


def _moved(pose: tuple[Array, Array], points: Float[Array, "k dim"]) -> Float[Array, "k dim"]:
    rotation, origin = pose
    return points @ rotation.T + origin


def _checked(scene: SoftScene, ties: Sequence[Tie]) -> tuple[tuple[Tie, ...], list[np.ndarray]]:
    """Returns valid ties, and for each the vertices of the components whose first tie it is."""
    count = len(scene.mesh.vertices)
    ties = tuple(tie._replace(vertices=indices_of("a tie", tie.vertices, count)) for tie in ties)
    if not ties or not all(len(tie.vertices) for tie in ties):
        raise InputError("ties name no vertex; expected at least one for each frame")
    tied = np.concatenate([tie.vertices for tie in ties])
    if len(loose := np.setdiff1d(tied, scene.held)):
        raise InputError(f"vertex {loose[0]} is tied but not held; pass the tied vertices to make_scene as held")
    if len(np.unique(tied)) < len(tied):
        raise InputError("a vertex is tied twice; expected each vertex in one tie")
    component = components_of_vertices(scene.mesh)
    frame_of, taken = [], np.zeros(len(component), bool)
    for tie in ties:
        vertices = np.isin(component, component[tie.vertices]) & ~taken
        taken |= vertices
        frame_of.append(np.flatnonzero(vertices))
    return ties, frame_of
