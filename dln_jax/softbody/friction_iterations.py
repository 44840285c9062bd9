"""Repeated solution of a time step, so that friction uses the normal forces at the end of the step.

    x^(j+1) = argmin E(x; normal forces and directions of friction at x^(j)),    x^(0) = x_n

These are the friction iterations of Li et al. 2020 (Incremental Potential Contact). A fixed point obeys Coulomb's law
with the normal forces at the end of the step. Convergence is not guaranteed, but the error usually falls by a constant
factor per iteration. Every solution warm-starts the next, which takes no Newton step once forces are constant.

The iterations are one loop of fixed length. Its derivative goes through the minimum of every iteration taken and is
exact whether or not the forces have stopped changing.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dln_jax.softbody.scene import SoftScene
from dln_jax.solvers.elements.energies import ElementEnergy, value
from dln_jax.solvers.elements.moving import MovingEnergy, moving_gradient
from dln_jax.solvers.newton import SolverInfo


def has_friction(scene: SoftScene) -> bool:
    """Whether a term or a contact of the scene has friction with lagged normal forces."""
    return any(term.lagged for term in scene.terms) or any(contact.friction for contact in scene.contacts)


def iterated(
    solve: Callable[[Array, Any], tuple[Array, SolverInfo]],
    prepared: Callable[[Array], Any],
    start: Float[Array, "n dim"],
    first: Any,
    count: int,
) -> tuple[Float[Array, "n dim"], SolverInfo, Any, Any]:
    """Solves a step once, and `count` times again.

    Args:
        solve: (start of the search, data) -> solution and its outcome.
        prepared: solution -> data with the normal forces there.
        start: start of the first search.
        first: data with the normal forces at the start of the step.
        count: at least 1.

    Returns:
        The last solution, the combined outcome (iterations are summed; converged if all solutions are), the data of
        the last solution, and the data with the normal forces there.
    """

    def again(carry: tuple[Array, Any, Any], _: None) -> tuple[tuple[Array, Any, Any], SolverInfo]:
        start, _, data = carry
        x, outcome = solve(start, data)
        return (x, data, prepared(x)), outcome

    (x, used, at_end), outcomes = jax.lax.scan(again, (start, first, first), None, length=count + 1)
    last = jax.tree.map(lambda values: values[-1], outcomes)
    overflow = None if outcomes.overflow is None else outcomes.overflow.any()
    outcome = last._replace(iterations=outcomes.iterations.sum(), converged=outcomes.converged.all(), overflow=overflow)
    return x, outcome, used, at_end


def friction_change(
    scene: SoftScene,
    energies: Sequence[ElementEnergy],
    moving: Sequence[MovingEnergy],
    x: Float[Array, "n dim"],
    before: Any,
    after: Any,
) -> Float[Array, ""]:
    """Returns the largest change of friction at x between the data of two steps, as force per mass in m/s²."""
    # The first energy is inertia.
    lagged = [number for number, term in enumerate(scene.terms, start=1) if term.lagged]
    rubs = [energy in contact.friction for contact in scene.contacts for energy in contact.energies]
    sliding = [number for number, has in enumerate(rubs) if has]

    def forces(step: Any) -> Array:
        slope = jnp.zeros_like(x)
        if lagged:
            rubbing, own = [energies[number] for number in lagged], [step.energies[number] for number in lagged]
            slope += jax.grad(lambda x: value(rubbing, x, own))(x)
        chosen, data = [moving[number] for number in sliding], [step.moving[number] for number in sliding]
        lists = tuple(energy.elements(x, slope, of) for energy, of in zip(chosen, data, strict=True))
        return slope + moving_gradient(chosen, x, lists, data)[1]

    change = jnp.abs(forces(after) - forces(before)) / scene.params.masses[:, None]
    return jnp.max(jnp.where(scene.free, change, 0))
