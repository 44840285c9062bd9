"""Soft bodies on a robot: held vertices move with its joints, and their forces act on the joints.

    tau + (dx_held/dq)ᵀ f = M(q) qdd + c(q, qd) + g(q),    x_held = carry(q, rest shape),    f = -dE/dx_held

E is the incremental potential of the soft body's step (its energies and inertia), minimised over the free vertices, so
f includes the weight and the inertia of the held vertices. Both equations hold at the end of the step: Newton's method
around the minimisation solves the first equation for the joint positions. Its Jacobian, the added stiffness and mass of
the soft body, comes from the implicit function theorem. The coupled step is therefore stable for any ratio of masses or
stiffnesses.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.softbody.integrators import BACKWARD_EULER, Integrator
from dln_jax.softbody.scene import Params, Previous, SoftScene, State
from dln_jax.softbody.step import Motion, Stepper, moved
from dln_jax.softbody.step_parts import Balanced, balance, conclude, forces_on_all, initial_state, step_problem
from dln_jax.softbody.verdict import Info, trusted
from dln_jax.solvers.newton import find_root
from dln_jax.types import InputError, Vector, require_positive

REACHED = 1e-9
"""Largest distance of a held vertex from its place on the robot, relative to the extent of the body. Contact can hold
back a vertex farther away."""


class TiedState(NamedTuple):
    """State of a robot and of its soft bodies."""

    robot: State
    """x is q [d] in rad or m, v is qd [d]."""
    body: State


def make_tied_step(
    scene: SoftScene,
    dt: float,
    carry: Callable[[Vector, Float[Array, "n dim"]], Float[Array, "n dim"]],
    inverse_dynamics: Callable[[Vector, Vector, Vector], Vector],
    integrator: Integrator = BACKWARD_EULER,
    *,
    torque_tolerance: float = 1e-6,
    joint_iterations: int = 20,
    **settings: Any,
) -> Stepper:
    """Returns (init, step) of a robot with soft bodies attached at their held vertices.

    init(q, qd=0, x=None, v=None) -> TiedState. By default the bodies have their rest shape on the robot. step(params,
    state, control=None, motion=None) -> (TiedState, Info of the soft bodies) is differentiable in all its arguments.
    `Motion.torque` holds the joint forces at the end of the step, by default zero. `Info.converged` also requires that
    the joint equations hold and that every held vertex is at its place. Each step takes one minimisation per iteration
    on q (2 or 3) and a final one.

    Args:
        scene: its held vertices move with the robot.
        dt: in s.
        carry: (q, rest shape) -> positions in m of all vertices rigidly attached to the robot. Return the vertices of
            other bodies unchanged.
        inverse_dynamics: (q, qd, qdd) -> tau of the robot alone, from a known tree or a learned model.
        integrator: `BACKWARD_EULER` or `BDF2`, for robot and bodies.
        torque_tolerance: largest residual of the joint equations, in N m (or N).
        joint_iterations: largest number of Newton iterations on q.
        settings: tolerance, iterations, linear_solver, definite and friction_iterations of `make_step`.

    Raises:
        InputError: the integrator's steps do not end in a balance of forces, no vertex is held, or `carry` returns
            another number of positions.
    """
    require_positive(dt=dt, torque_tolerance=torque_tolerance, joint_iterations=joint_iterations)
    if integrator.span != 1.0 or integrator.averaged:
        raise InputError("tied steps need an integrator that ends in a balance of forces: BACKWARD_EULER or BDF2")
    if not len(scene.held):
        raise InputError("the scene has no held vertex; pass the vertices on the robot to make_scene as held")
    problem, held = step_problem(scene, dt, integrator, **settings), scene.held
    reached = REACHED * float(np.ptp(scene.mesh.vertices, axis=0).max())

    def carried(q: Vector, rest: Array) -> Array:
        x = carry(q, rest)
        if x.shape != rest.shape:
            raise InputError(f"carry returned positions of shape {x.shape}; expected {rest.shape}: all vertices")
        return x

    def init(q: Any, qd: Any = 0.0, x: Any = None, v: Any = None) -> TiedState:
        q = jnp.asarray(q, float)
        qd = jnp.broadcast_to(jnp.asarray(qd, float), q.shape)
        x_carried, v_carried = jax.jvp(lambda q: carried(q, scene.params.rest), (q,), (qd,))
        body = initial_state(problem, x_carried if x is None else x, v_carried if v is None else v)
        before = Previous(q, qd, jnp.asarray(False)) if integrator.two_steps else None
        return TiedState(State(q, qd, before), body._replace(x=body.x.at[held].set(x_carried[held])))

    def soft(params: Params, body: State, q: Vector, control: Any) -> tuple[State, Balanced]:
        _, driven = moved(scene, params, body, Motion(carried(q, params.rest)[held]), dt)
        balanced = balance(problem, params, driven, control, dt)
        # The inertia of the held vertices refers to their motion before the step.
        (weights, _), *others = balanced.data.energies
        energies = ((weights, integrator.target(body, dt)[1]), *others)
        return driven, balanced._replace(data=balanced.data._replace(energies=energies))

    def residual(q: Vector, params: Params, state: TiedState, tau: Vector, control: Any) -> Vector:
        h, target = integrator.target(state.robot, dt)
        _, qd = integrator.finish(state.robot, q, dt)
        _, balanced = soft(params, state.body, q, control)
        back = jax.vjp(lambda q: carried(q, params.rest)[held], q)[1](forces_on_all(problem, balanced)[held])[0]
        return inverse_dynamics(q, qd, (q - target) / h**2) - tau - back

    def step(
        params: Params, state: TiedState, control: Any = None, motion: Motion | None = None
    ) -> tuple[TiedState, Info]:
        robot, motion = state.robot, motion or Motion()
        if motion.held is not None:
            raise InputError("the motion moves held vertices, but the robot moves them; leave them out")
        params, _ = moved(scene, params, state.body, motion, dt)
        tau = jnp.zeros_like(robot.x) if motion.torque is None else jnp.asarray(motion.torque, robot.x.dtype)
        q, outcome = find_root(
            residual,
            robot.x + dt * robot.v,
            params,
            state,
            tau,
            control,
            tolerance=torque_tolerance,
            iterations=joint_iterations,
        )
        body, info = conclude(problem, params, *soft(params, state.body, q, control), dt)
        missed = jnp.max(jnp.abs(body.x[held] - carried(q, params.rest)[held]))
        # Held vertices move with the body, so the integrator gives their velocity.
        v = integrator.finish(state.body, body.x, dt)[1][held]
        body = body._replace(v=body.v.at[held].set(v))
        if integrator.two_steps:
            body = body._replace(previous=Previous(state.body.x, state.body.v, jnp.asarray(True)))
        converged = info.converged & outcome.converged & (missed <= reached)
        before = Previous(robot.x, robot.v, jnp.asarray(True)) if integrator.two_steps else None
        q, qd = trusted(integrator.finish(robot, q, dt), converged)
        return TiedState(State(q, qd, before), body), info._replace(converged=converged)

    return Stepper(init, step)
