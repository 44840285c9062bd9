"""Implicit time steps that minimise the potential of `integrators` (Rojas et al. 2021; Martin et al. 2011), and static
equilibria: minima of the potential without inertia.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dln_jax.softbody.integrators import BACKWARD_EULER, Integrator
from dln_jax.softbody.scene import (
    Params,
    SoftScene,
    State,
    contact_energies,
    element_energies,
    prepare,
    prepare_contacts,
    with_parameters,
)
from dln_jax.softbody.step_parts import balance, conclude, initial_state, step_problem
from dln_jax.softbody.substeps import with_shorter_steps
from dln_jax.softbody.verdict import TOLERANCE, Info, trusted, verdict_on_positions
from dln_jax.solvers.elements.assembly import pattern
from dln_jax.solvers.elements.linear_solvers import LinearSolverFactory, known_data, least_work
from dln_jax.solvers.elements.minimise import minimise
from dln_jax.types import InputError, require_positive

Step = Callable[..., tuple[Any, Info]]


class Motion(NamedTuple):
    """Motion of held vertices and rigid surfaces in a step; `None` for no motion."""

    held: Float[Array, "k dim"] | None = None
    """Positions in m of the scene's held vertices at the end of the step, in ascending order of the vertices. Without
    them, held vertices keep their velocity."""
    surfaces: Mapping[str, Mapping[str, Any]] | None = None
    """Places of planes and obstacles at the end of the step, as for `with_parameters`: {"belt": {"centre": c}}.
    Friction and damping take their velocity from the previous step. The parameters place all other surfaces."""
    torque: Float[Array, " d"] | None = None
    """Generalised forces in N m or N at the joints of a robot (`make_tied_step`) at the end of the step."""


class Stepper(NamedTuple):
    """A time step and its initial state."""

    init: Callable[..., Any]
    """init(x=None, v=None): by default the rest shape at rest; positions in m and velocities in m/s are [n, dim] or one
    [dim] for all vertices. Raises `InputError` for a known value that is not finite."""
    step: Step
    """step(params, state, control=None, motion=None) -> (state after dt, Info): differentiable in all of its arguments.
    The control is an array for the scene's only actuator, or a dict of arrays by the names of the actuated terms; the
    motion is a `Motion`."""


def make_step(
    scene: SoftScene,
    dt: Any,
    integrator: Integrator = BACKWARD_EULER,
    *,
    tolerance: float = TOLERANCE,
    iterations: int = 100,
    linear_solver: LinearSolverFactory | None = None,
    definite: bool = False,
    halvings: int = 0,
    friction_iterations: int = 1,
) -> Stepper:
    """Returns (init, step) of a scene.

    Args:
        scene: the body; only its own terms are compiled.
        dt: in s. With a traced value one program serves several step lengths; its sign is not checked.
        integrator: `BACKWARD_EULER`, `BDF2`, `MIDPOINT`, `AVERAGE_VECTOR_FIELD` or a custom one.
        tolerance: largest residual force per mass, in m/s², of a converged step; rounding always counts as converged.
        iterations: largest number of Newton steps per time step; `Info.converged` is false if they do not suffice.
        linear_solver: solver of the linear systems; by default the cheapest for the stiffness in `scene.params` and
            this time step (`by_size` if either is traced, or if a term's preparation needs a control). Later parameters
            of the step do not change the choice.
        definite: also report `Info.definite`, which takes another Hessian, factorisation and solve in every step.
        halvings: repeat a step that does not converge in parts of at least dt/2^halvings; `Info.substeps` reports their
            number. This compiles the step a second time.
        friction_iterations: number of repeated solutions of the step with normal forces and friction directions from
            the previous solution (see `softbody.step_parts`). `Info.friction_change` reports the change by one more.
            With 0, friction lags by a step.

    Raises:
        InputError: a number is not positive, or halvings are used with a two-step method.
    """
    if halvings:
        require_positive(halvings=halvings)
        if integrator.two_steps:
            raise InputError("halvings need a one-step method; use another integrator")
    problem = step_problem(
        scene,
        dt,
        integrator,
        tolerance=tolerance,
        iterations=iterations,
        linear_solver=linear_solver,
        definite=definite,
        friction_iterations=friction_iterations,
    )

    def advance(
        params: Params, state: State, control: Any = None, dt: Any = dt, x_after: Array | None = None
    ) -> tuple[State, Info]:
        return conclude(problem, params, state, balance(problem, params, state, control, dt, x_after), dt)

    whole = with_shorter_steps(advance, dt, halvings) if halvings else advance

    def step(params: Params, state: State, control: Any = None, motion: Motion | None = None) -> tuple[State, Info]:
        if motion is not None and motion.torque is not None:
            raise InputError("the motion has a torque, but the scene has no robot; use make_tied_step")
        return whole(*moved(scene, params, state, motion, dt), control)

    return Stepper(partial(initial_state, problem), step)


def moved(scene: SoftScene, params: Params, state: State, motion: Motion | None, dt: Any) -> tuple[Params, State]:
    """Returns the parameters with the places of surfaces, and the state with the velocities of held vertices."""
    if motion is not None and motion.held is not None:
        held, (k, dimension) = jnp.asarray(motion.held, state.x.dtype), (len(scene.held), scene.mesh.dimension)
        if held.shape != (k, dimension):
            raise InputError(f"the motion moves held vertices to {held.shape} numbers; expected {k, dimension}")
        state = state._replace(v=state.v.at[scene.held].set((held - state.x[scene.held]) / dt))
    if motion is not None and motion.surfaces is not None:
        params = with_parameters(params, **motion.surfaces)
    return params, state


def positions_and_convergence(state: State, info: Info) -> tuple[Array, Array]:
    """Returns x [n, dim] and the convergence flag of a step, for `rollout`."""
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
    """Returns positions [n, dim] of an equilibrium, a minimum of the potential near x (default: rest shape), and Info.

    Args:
        scene: the body; without held vertices or springs to the world the minimum is not unique.
        control: actuation, for scenes with actuators.
        x: initial positions; held vertices stay there.
        tolerance, iterations, linear_solver, definite: as for `make_step`.
    """
    x = params.rest if x is None else x
    data = prepare(scene, params, x, control=control)
    energies, (count, dimension) = element_energies(scene), scene.mesh.vertices.shape
    at = pattern(energies, count, dimension, scene.free)
    known = known_data((params, x, control), lambda: data)
    solver = (linear_solver or least_work(energies, at, x, known))(energies, at)
    contact = prepare_contacts(scene, params, x)
    x, outcome = minimise(
        energies,
        x,
        data,
        free=scene.free,
        scale=params.masses,
        tolerance=tolerance,
        iterations=iterations,
        linear_solver=lambda *_: solver,
        at=at,
        definite=definite,
        moving=contact_energies(scene),
        moving_data=contact,
    )
    info = verdict_on_positions(scene, *jax.lax.stop_gradient((params, x, outcome)), contact)
    return trusted(x, info.converged), info
