"""Drawing of soft bodies: triangles in the plane, or the lit skin of a body in space seen obliquely from above."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dln_jax.softbody.mesh.mesh import Mesh

BODY, EDGE, SKIN = np.array((0.62, 0.75, 0.87)), np.array((0.46, 0.58, 0.71)), np.array((0.16, 0.26, 0.38))
GROUND, GROUND_LINE = "0.90", (0.35, 0.33, 0.30)
# View direction in space: a turn about the vertical axis, then a tilt; radians.
_TURN, _TILT = np.deg2rad(-55.0), np.deg2rad(22.0)
_LIGHT = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])


class Drawn(NamedTuple):
    """Filled polygons and their colours."""

    polygons: Float[np.ndarray, "k 3 2"]
    """Polygons in the drawing plane, the farthest first."""
    colours: Float[np.ndarray, "#k 3"]


def view(dimension: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors of the view: right, away from the viewer, and up."""
    if dimension == 2:
        return np.array([1.0, 0.0]), np.zeros(2), np.array([0.0, 1.0])
    right = np.array([np.cos(_TURN), np.sin(_TURN), 0.0])
    away = np.array([-np.sin(_TURN) * np.cos(_TILT), np.cos(_TURN) * np.cos(_TILT), -np.sin(_TILT)])
    return right, away, np.cross(right, away)


def flattened(positions: Float[np.ndarray, "*k dim"]) -> Float[np.ndarray, "*k 2"]:
    """Projects positions onto the drawing plane."""
    right, _, up = view(positions.shape[-1])
    return np.stack([positions @ right, positions @ up], axis=-1)


def drawn(mesh: Mesh, skin: Int[np.ndarray, "faces dim"], positions: Float[np.ndarray, "n dim"]) -> Drawn:
    """Polygons of the body at these positions; in space, the faces of its skin that face the viewer."""
    flat = flattened(positions)
    if mesh.dimension == 2:
        return Drawn(flat[mesh.elements], BODY[None])
    _, away, _ = view(3)
    corners = positions[skin]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.where(length > 0, length, 1.0)
    order = np.argsort(-(corners @ away).mean(axis=1))
    order = order[(normal @ away)[order] < 0]
    return Drawn(flat[skin[order]], np.clip((0.8 + 0.2 * (normal @ _LIGHT))[order, None] * BODY, 0, 1))


def floor(positions: Float[np.ndarray, "*k 3"], height: float) -> Float[np.ndarray, "4 2"]:
    """The rectangle below all positions, in the drawing plane."""
    flat = positions[..., :2].reshape(-1, 2)
    (west, south), (east, north) = flat.min(axis=0), flat.max(axis=0)
    return flattened(
        np.array([[west, south, height], [east, south, height], [east, north, height], [west, north, height]])
    )
