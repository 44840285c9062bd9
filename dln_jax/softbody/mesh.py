"""Meshes of simplices: triangles in the plane, tetrahedra in space."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


class Mesh(NamedTuple):
    """Vertices and the simplices they span."""

    vertices: Float[np.ndarray, "n dim"]
    """Rest shape in m; dim is 2 or 3."""
    elements: Int[np.ndarray, "m corners"]
    """Corners of each triangle (dim 2) or tetrahedron (dim 3), positively oriented."""

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.vertices.shape[1]
