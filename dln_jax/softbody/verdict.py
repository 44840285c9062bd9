"""Reliability of a time step, because balanced forces are not enough.

A long step of an undamped method can create energy without bound, and an impact can invert elements, even with balanced
forces in every step. Over one step,

    growth = (T + V)' - (T + V) - W,    at hand = T + max(V - V', 0) + |W|

with the kinetic energy T of the free vertices, the potential V (both values with the actuation and the lagged contact
of this step) and the work W done by held vertices. The exact motion has growth <= 0. A step that creates more than
`LARGEST_GROWTH` of the energy at hand has diverged. Slow growth, a percent per step, contains no such step. Therefore
the state also carries the energy created since its minimum, max(created + growth, 0). It must not exceed the same share
of the largest energy at hand so far.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dln_jax.softbody.mesh.simplices import volume_ratios
from dln_jax.softbody.scene import Growth, Params, SoftScene, element_energies, least_distance
from dln_jax.solvers.elements.energies import ElementEnergy, value
from dln_jax.solvers.elements.moving import MovingEnergy, moving_gradient
from dln_jax.solvers.newton import SolverInfo

TOLERANCE = 1e-6
"""Default of the largest residual force per mass, in m/s²; Newton's last step usually goes far below it."""
LARGEST_GROWTH = 0.1
"""Share of the energy at hand. In the example scenes, backward Euler, BDF2 and the average-vector-field method stay
below 0.012 per step and 0.023 per motion, and smooth motions of the midpoint rule below 1e-3; unresolved contact of the
midpoint rule reaches 0.1 to 5 before it diverges."""


class Info(NamedTuple):
    """Outcome of a time step or a static solve."""

    residual: Float[Array, ""]
    """Largest residual force per mass, in m/s²."""
    iterations: Int[Array, ""]
    """Newton iterations."""
    converged: Bool[Array, ""]
    """True for a reliable result: balanced forces, no divergence, no inverted element. Otherwise derivatives are
    NaN."""
    definite: Bool[Array, ""] | None = None
    """True if the Hessian at the minimum is positive definite; `None` unless requested."""
    energy_growth: Float[Array, ""] | None = None
    """Energy created by the step, in J; negative for damping. `None` for a static solve."""
    energy_at_hand: Float[Array, ""] | None = None
    """Energy available to the step, in J, including rounding and tolerance. `None` for a static solve."""
    diverged: Bool[Array, ""] | None = None
    """True if step or motion created more than `LARGEST_GROWTH` of the energy at hand. `None` for a static solve."""
    least_J: Float[Array, ""] | None = None
    """Smallest volume ratio J of elastic elements, if any; at quadrature points if quadratic."""
    substeps: Int[Array, ""] | None = None
    """Number of parts of the step, 1 for a whole step; `None` without `halvings`."""
    least_distance: Float[Array, ""] | None = None
    """Smallest distance in m between surfaces in contact, capped at the contact distance."""
    friction_change: Float[Array, ""] | None = None
    """Largest change of friction on a vertex, as force per mass in m/s², if normal forces and directions were taken
    from the end of the step; `None` without friction or `friction_iterations`. Does not affect `converged`."""
    overflow: Bool[Array, ""] | None = None
    """True if a list of contact pairs was too short: the step does not converge and needs a larger `capacity`."""


def verdict_on_energies(
    info: Info,
    before: Growth | None,
    scene: SoftScene,
    masses: Float[Array, " n"],
    data: Sequence[Any],
    x: tuple[Array, Array],
    v: tuple[Array, Array],
    work: Float[Array, ""],
    outcome: SolverInfo,
    contact: Float[Array, "2"] | float,
) -> tuple[Info, Growth | None]:
    """Adds the verdict on energies; returns the outcome, and the energy created so far if the state tracks it.

    Args:
        info: the verdict on positions.
        before: energy created before the step.
        scene: its terms and free vertices.
        masses: in kg.
        data: data of the terms' elements in this step.
        x, v: positions and velocities at the start and the end of the step.
        work: work of the held vertices, in J.
        contact: energies in J of contacts at the start and at the end.
    """
    free = jnp.asarray(scene.free)
    kinetic, after = (0.5 * jnp.sum(jnp.where(free, masses[:, None] * velocity**2, 0)) for velocity in v)
    energies = element_energies(scene)
    # One trace for both, because the energies are most of the program.
    stored, stored_after = contact + jax.vmap(lambda at: value(energies, at, data))(jnp.stack(x))
    noise = 0.0 if outcome.energy_noise is None else outcome.energy_noise
    # The part of the energy at hand due to rounding and to the work of the residual forces.
    unclear = noise + outcome.residual * jnp.sum(masses[:, None] * jnp.abs(x[1] - x[0]))
    growth = after - kinetic + (stored_after - stored) - work
    at_hand = kinetic + jnp.maximum(stored - stored_after, 0) + jnp.abs(work) + unclear
    sound, so_far = growth <= LARGEST_GROWTH * at_hand, None
    if before is not None:
        created = jnp.maximum(before.created + growth - unclear, 0)
        so_far = Growth(created, jnp.maximum(before.at_hand, at_hand - created))
        sound &= created <= LARGEST_GROWTH * so_far.at_hand
    converged = info.converged & sound
    info = info._replace(converged=converged, energy_growth=growth, energy_at_hand=at_hand, diverged=~sound)
    return info, so_far


def work_of_held(
    held: Int[np.ndarray, " k"], energies: Sequence[ElementEnergy], data: Sequence[Any], x: Array, moved: Array
) -> Float[Array, ""]:
    """Returns the work of held vertices against the forces at x, in J, from the elements at these vertices."""
    near, their_data = [], []
    for energy, of in zip(energies, data, strict=True):
        touched = np.flatnonzero(np.isin(energy.indices, held).any(axis=1))
        if len(touched):
            near.append(energy._replace(indices=energy.indices[touched]))
            their_data.append(jax.tree.map(lambda leaf, touched=touched: leaf[touched], of))
    if not near:
        return jnp.zeros((), x.dtype)
    along = jnp.zeros_like(moved).at[held].set(moved[held])
    return jax.jvp(lambda x: value(near, x, their_data), (x,), (along,))[1]


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


def verdict_on_positions(
    scene: SoftScene, params: Params, x: Array, outcome: SolverInfo, contact: Sequence[Any]
) -> Info:
    """Combines the solver's verdict with the check of positions: no element may be inverted."""
    elements, least, converged = scene.mesh.nodes, None, outcome.converged
    if len(elements) and any(np.array_equal(term.indices, elements) for term in scene.terms):
        least = jnp.min(volume_ratios(x, params.rest, elements))
        converged &= least > 0
    return Info(
        outcome.residual,
        outcome.iterations,
        converged,
        outcome.definite,
        least_J=least,
        least_distance=least_distance(scene, x, outcome.lists[1], contact),
        overflow=outcome.overflow,
    )


@jax.custom_jvp
def trusted(values: Any, converged: Bool[Array, ""]) -> Any:
    """Returns the values; without convergence their derivatives are NaN."""
    return values


@trusted.defjvp
def _trusted_derivative(primals: tuple[Any, Any], tangents: tuple[Any, Any]) -> tuple[Any, Any]:
    values, converged = primals
    known = jax.tree.map(lambda dot: dot * jnp.where(converged, 1.0, jnp.nan).astype(dot.dtype), tangents[0])
    return values, known
