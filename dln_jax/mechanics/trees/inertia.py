"""The ten inertial parameters of a rigid body; its energies and forces are linear in them.

    theta = (m, h_x, h_y, h_z, I_xx, I_xy, I_xz, I_yy, I_yz, I_zz)

m in kg; h = m c in kg m, with the centre of mass c; I in kg m² about the origin of the body's frame, in its axes.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

PARAMETERS = ("m", "h_x", "h_y", "h_z", "I_xx", "I_xy", "I_xz", "I_yy", "I_yz", "I_zz")
Inertia = Float[Array, "10"] | Float[np.ndarray, "10"]
_ROWS, _COLUMNS = np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2])
_PLACES = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


def inertial_parameters(mass: Any, centre: Any, about_centre: Any) -> Inertia:
    """Returns theta of a body, as a NumPy array in double precision if all arguments are known.

    Args:
        mass: m, kg.
        centre: centre of mass [3], m.
        about_centre: moments of inertia about the centre of mass [3, 3], kg m².
    """
    numpy, m, c, about = _alike(mass, centre, about_centre)
    return _joined(numpy, m, m * c, about + m * (c @ c * np.eye(3) - c[:, None] * c))


def parts(theta: Inertia) -> tuple[Any, Any, Any]:
    """Returns m, h [3] and I [3, 3]."""
    return theta[0], theta[1:4], theta[4:][_PLACES]


def moved(theta: Inertia, rotation: Any, position: Any) -> Inertia:
    """Returns theta in another frame; rotation (columns are axes) and position place the body's frame in it."""
    numpy, own, R, r = _alike(theta, rotation, position)
    m, h, moments = parts(own)
    turned = R @ h
    shifted = (2 * (turned @ r) + m * (r @ r)) * np.eye(3)
    outer = turned[:, None] * r + r[:, None] * turned + m * r[:, None] * r
    return _joined(numpy, m, turned + m * r, R @ moments @ R.T + shifted - outer)


def pseudo_inertia(theta: Inertia) -> Any:
    """Returns J, which is positive definite only for physically consistent bodies (Wensing, Kim, Slotine, RA-L 2018).

    J = [[tr(I) / 2 - I, h], [hᵀ, m]]
    """
    numpy, own = _alike(theta)
    m, h, moments = parts(own)
    spread = 0.5 * numpy.trace(moments) * np.eye(3) - moments
    return numpy.block([[spread, h[:, None]], [h[None, :], m.reshape(1, 1)]])


def body_of_pseudo_inertia(J: Any) -> Inertia:
    """Returns theta from the pseudo-inertia J [4, 4]; inverts `pseudo_inertia`."""
    numpy, own = _alike(J)
    return _joined(numpy, own[3, 3], own[:3, 3], numpy.trace(own[:3, :3]) * np.eye(3) - own[:3, :3])


def _joined(numpy: Any, m: Any, h: Any, moments: Any) -> Any:
    return numpy.concatenate([m.reshape(1), h, moments[_ROWS, _COLUMNS]])


def _alike(*arrays: Any) -> list[Any]:
    """Returns jax.numpy if any array is a JAX array, otherwise numpy, and the arrays converted to it."""
    if any(isinstance(array, Array) for array in arrays):
        return [jnp, *map(jnp.asarray, arrays)]
    return [np, *(np.asarray(array, float) for array in arrays)]
