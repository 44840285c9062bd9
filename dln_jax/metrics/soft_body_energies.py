"""Energies of a soft body in motion: kinetic, and term by term."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.softbody.scene import Params, SoftScene, element_energies, prepare
from dln_jax.solvers.elements.energies import value

KINETIC, TOTAL = "kinetic", "total"
# Number of moments evaluated at a time.
_BATCH = 32


def motion_energies(
    scene: SoftScene,
    params: Params,
    x: Float[Array, "T n dim"],
    v: Float[Array, "T n dim"],
    control: Float[Array, "T k"] | None = None,
) -> dict[str, Float[np.ndarray, " T"]]:
    """Returns the kinetic energy, the energy of each term, and their total, all in J, at each time of a motion.

    Gravity has zero potential at the origin. Friction stores nothing.
    """
    energies = element_energies(scene)

    def of_moment(moment: tuple[Array, Array, Array | None]) -> dict[str, Array]:
        x, v, control = moment
        data = prepare(scene, params, x, control=control)
        stored = {
            term.name: value([energy], x, [of_term])
            for term, energy, of_term in zip(scene.terms, energies, data, strict=True)
        }
        return {KINETIC: 0.5 * jnp.sum(params.masses[:, None] * v**2), **stored}

    moments = (jnp.asarray(x), jnp.asarray(v), control)
    arrays = jax.jit(lambda moments: jax.lax.map(of_moment, moments, batch_size=_BATCH))(moments)
    by_name = {name: np.asarray(arrays[name]) for name in (KINETIC, *(term.name for term in scene.terms))}
    return {**by_name, TOTAL: np.sum(list(by_name.values()), axis=0)}
