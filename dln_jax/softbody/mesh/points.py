"""Points inside bodies: the element that contains a point, and the point's shape-function values."""

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.mesh.simplices import SIDES
from dln_jax.types import InputError

_OUTSIDE = 1e-9
"""Smallest barycentric coordinate accepted for a point on the surface, to allow for rounding."""


def located(mesh: Mesh, points: ArrayLike) -> tuple[Int[np.ndarray, "p nodes"], Float[np.ndarray, "p nodes"]]:
    """Returns the nodes of the elements that contain points of the rest shape (in m), and the shape functions there.

    A point moves with the body: its position is the sum of its nodes' positions, weighted by these values.

    Raises:
        InputError: points of a wrong shape, or a point outside the body.
    """
    positions = np.asarray(points, dtype=float)
    if positions.ndim != 2 or positions.shape[1] != mesh.dimension or not np.isfinite(positions).all():
        raise InputError(
            f"points have shape {list(positions.shape)}; expected finite numbers [p, {mesh.dimension}], in m"
        )
    corners = mesh.vertices[mesh.elements]
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    elements, coordinates = [], []
    for number, point in enumerate(positions):
        later = np.linalg.solve(edges, (point - corners[:, 0])[..., None])[..., 0]
        of_elements = np.concatenate([1 - later.sum(axis=1, keepdims=True), later], axis=1)
        best = int(np.argmax(of_elements.min(axis=1)))
        if of_elements[best].min() < -_OUTSIDE:
            raise InputError(
                f"point {number} at {point.tolist()} m is outside of the body; expected a point in an element"
            )
        elements.append(best)
        coordinates.append(of_elements[best])
    shares = np.array(coordinates)
    if mesh.midsides is not None:
        i, j = np.array(SIDES[mesh.dimension]).T
        shares = np.concatenate([shares * (2 * shares - 1), 4 * shares[:, i] * shares[:, j]], axis=1)
    return mesh.nodes[elements], shares
