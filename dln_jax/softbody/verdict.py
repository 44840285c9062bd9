"""Reliability of a time step: balanced forces are not sufficient.

A long step of a rule that does not damp can create energy without bound, and an impact can invert elements, while the
forces of every step are balanced. Over one step,

    growth = (T + V)' - (T + V) - W,    at hand = T + max(V - V', 0) + |W|

with the kinetic energy T of the free vertices, the potential V (both values with the actuation and the lagged contact
of this step) and the work W done by held vertices. The exact motion has growth <= 0. A step that creates more than
`LARGEST_GROWTH` of the energy at hand has diverged.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dln_jax.softbody.mesh.simplices import simplex_volumes
from dln_jax.softbody.scene import Params, SoftScene
from dln_jax.solvers.elements.energies import ElementEnergy, value
from dln_jax.solvers.newton import SolverInfo

LARGEST_GROWTH = 0.1
"""Share of the energy at hand. The example scenes stay below 0.01 with backward Euler and BDF2, and smooth motions
below 1e-4 with the midpoint rule; contact that the midpoint rule does not resolve reaches 0.1 to 5 before it
diverges."""


class Info(NamedTuple):
    """Outcome of a time step or a static solve."""

    residual: Float[Array, ""]
    """Largest residual force per mass, in m/s²."""
    iterations: Int[Array, ""]
    """Newton iterations."""
    converged: Bool[Array, ""]
    """Whether the result can be trusted: forces are balanced, the step has not diverged (`energy_growth` is at most
    `LARGEST_GROWTH` of `energy_at_hand`), and no element is inverted (`least_J` > 0). Otherwise derivatives are NaN."""
    definite: Bool[Array, ""] | None = None
    """Whether the Hessian at the minimum is positive definite; `None` unless requested."""
    energy_growth: Float[Array, ""] | None = None
    """Energy created by the step, in J; negative for damping. `None` for a static solve."""
    energy_at_hand: Float[Array, ""] | None = None
    """Energy available to the step, in J, with the effect of rounding and tolerance. `None` for a static solve."""
    least_J: Float[Array, ""] | None = None
    """Smallest ratio of an element's volume to its rest volume, over elements that resist deformation, if any."""
    overlaps: Int[Array, ""] | None = None
    """Number of pairs of overlapping mesh components: bodies have no contact with each other and pass through. `None`
    for a mesh of one component and for a scene with contact of its bodies. It does not affect `converged`."""
    least_distance: Float[Array, ""] | None = None
    """Smallest distance in m of two surfaces in contact, at most the distance within which contact acts."""
    overflow: Bool[Array, ""] | None = None
    """Whether the lists of pairs in contact were too short, which needs a larger `capacity`; such a step has not
    converged."""


def energy_balance(
    scene: SoftScene,
    energies: Sequence[ElementEnergy],
    masses: Float[Array, " n"],
    data: Sequence[Any],
    x: tuple[Array, Array],
    v: tuple[Array, Array],
    balanced: Array,
    outcome: SolverInfo,
    contact: Callable[[Array], Array],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """(growth, energy at hand) of a step, in J.

    Args:
        scene: its held vertices do work.
        energies, data: its terms and the data of their elements in this step.
        masses: in kg.
        x, v: positions and velocities at the start and the end of the step.
        balanced: the positions at which forces were balanced.
        outcome: of the minimisation.
        contact: positions -> energy in J of the contact between bodies.
    """
    free = jnp.asarray(scene.free)
    kinetic, after = (0.5 * jnp.sum(jnp.where(free, masses[:, None] * velocity**2, 0)) for velocity in v)
    stored, stored_after = (value(energies, at, data) + contact(at) for at in x)
    moved = x[1] - x[0]
    work = _work(scene.held, energies, data, balanced, moved) if len(scene.held) else jnp.zeros_like(kinetic)
    if len(scene.held) and scene.contacts:
        along = jnp.zeros_like(moved).at[scene.held].set(moved[scene.held])
        work += jax.jvp(contact, (balanced,), (along,))[1]
    # Residual forces do work, and rounding hides some of the energy.
    noise = 0.0 if outcome.energy_noise is None else outcome.energy_noise
    unclear = noise + outcome.residual * jnp.sum(masses[:, None] * jnp.abs(moved))
    growth = after - kinetic + (stored_after - stored) - work
    return growth, kinetic + jnp.maximum(stored - stored_after, 0) + jnp.abs(work) + unclear


def _work(
    held: Int[np.ndarray, " k"], energies: Sequence[ElementEnergy], data: Sequence[Any], x: Array, moved: Array
) -> Float[Array, ""]:
    """Work of held vertices against the forces at x, from the elements at these vertices."""
    near, their_data = [], []
    for energy, of in zip(energies, data, strict=True):
        touched = np.flatnonzero(np.isin(energy.indices, held).any(axis=1))
        if len(touched):
            near.append(energy._replace(indices=energy.indices[touched]))
            their_data.append(jax.tree.map(lambda leaf, touched=touched: leaf[touched], of))
    along = jnp.zeros_like(moved).at[held].set(moved[held])
    return jax.jvp(lambda x: value(near, x, their_data), (x,), (along,))[1]


def least_J(scene: SoftScene, params: Params, x: Float[Array, "n dim"]) -> Float[Array, ""] | None:
    """Smallest ratio of an element's volume to its rest volume; `None` if no term acts on the mesh's elements."""
    elements = scene.mesh.elements
    if not len(elements) or not any(np.array_equal(term.indices, elements) for term in scene.terms):
        return None
    return jnp.min(simplex_volumes(x, elements) / simplex_volumes(params.rest, elements))


@jax.custom_jvp
def trusted(values: Any, converged: Bool[Array, ""]) -> Any:
    """Returns the values; their derivatives are NaN unless converged."""
    return values


@trusted.defjvp
def _trusted_derivative(primals: tuple[Any, Any], tangents: tuple[Any, Any]) -> tuple[Any, Any]:
    values, converged = primals
    known = jax.tree.map(lambda dot: dot * jnp.where(converged, 1.0, jnp.nan).astype(dot.dtype), tangents[0])
    return values, known
