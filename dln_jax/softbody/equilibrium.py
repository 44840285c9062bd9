"""Static equilibria: minima of the potential without inertia."""

from typing import Any

import jax
from jaxtyping import Array, Float

from dln_jax.softbody.scene import (
    Params,
    SoftScene,
    contact_energies,
    element_energies,
    prepare,
    prepare_contacts,
)
from dln_jax.softbody.verdict import (
    TOLERANCE,
    Info,
    trusted,
    verdict_on_positions,
)
from dln_jax.solvers.elements.assembly import pattern
from dln_jax.solvers.elements.linear_solvers import LinearSolverFactory
from dln_jax.solvers.elements.minimise import minimise
from dln_jax.solvers.elements.selection import known_data, least_work


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
