"""The body that all simulators receive, and a reference of its motion that shares no code with any of them.

The reference integrates M a = f(x) with Störmer and Verlet's explicit method (order 2) in NumPy, with the first
Piola-Kirchhoff stress of the material written out, and extrapolates two step lengths. It damps nothing.
"""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dln_jax.softbody.mesh.mesh import Mesh, lumped_masses

GRAVITY, DENSITY = 9.81, 1000.0
NEO_HOOKEAN, KIRCHHOFF, SMITH = "stable neo-Hookean", "St. Venant-Kirchhoff", "Smith's neo-Hookean"
"""Laws; the last is Smith et al.'s (2018) with the logarithm, whose parameters are 4/3 mu and lambda + 5/6 mu."""


class Body(NamedTuple):
    """Bodies that start under their weight, perhaps above a rigid floor z = 0 or each other, without friction."""

    mesh: Mesh
    held: Int[np.ndarray, " k"]
    modulus: float
    """Young's modulus, Pa."""
    ratio: float
    """Poisson's ratio."""
    times: Float[np.ndarray, " s"]
    """Times for comparing positions, multiples of all steps, s."""
    floor: bool = False
    law: str = NEO_HOOKEAN
    near: float = 0.0
    """Largest distance, m, of surfaces of the mesh's components that repel each other; 0 for no contact."""
    v: Float[np.ndarray, "n 3"] | float = 0.0
    """Velocities at the start, m/s."""

    @property
    def lame(self) -> tuple[float, float]:
        """(mu, lambda) in Pa."""
        mu = self.modulus / (2 * (1 + self.ratio))
        return mu, 2 * mu * self.ratio / (1 - 2 * self.ratio)


class Run(NamedTuple):
    """A motion by one simulator with one setting."""

    x: Float[np.ndarray, "s n 3"]
    seconds: float
    """Processor time per simulated second, s, without compilation."""
    compiling: float
    """Elapsed time until the first result, less that of a second run, s."""


def measured(body: Body, run: Callable[[], Any], repetitions: int = 2) -> Run:
    """Times a function that returns the positions: a first call compiles, the fastest of the others counts.

    Calls of more than 2 s are not repeated.
    """
    began = time.perf_counter()
    run()
    first = time.perf_counter() - began
    taken, elapsed, x = [], [], None
    for _ in range(repetitions):
        began, start = time.perf_counter(), time.process_time()
        x = np.asarray(run())
        taken.append(time.process_time() - start)
        elapsed.append(time.perf_counter() - began)
        if taken[-1] > 2.0:
            break
    assert x is not None
    return Run(x, min(taken) / float(body.times[-1]), max(first - min(elapsed), 0.0))


def relative_error(body: Body, x: Float[np.ndarray, "s n 3"], reference: Float[np.ndarray, "s n 3"]) -> float:
    """Norm of the difference over that of the displacement, weighted by mass, over all times; inf if not finite."""
    weights = lumped_masses(body.mesh, DENSITY)[:, None]
    squares = [float(np.sum(weights * d**2)) for d in (x - reference, reference - body.mesh.vertices)]
    error = np.sqrt(squares[0] / squares[1])
    return float(error) if np.isfinite(error) else float("inf")


def reference_motion(body: Body, dt: float, stiffness: float = 1e7) -> Float[np.ndarray, "s n 3"]:
    """Positions at `body.times`, extrapolated from steps of dt and dt/2 in s; the floor is a penalty in N/m."""
    coarse, fine = (_explicit(body, step, stiffness) for step in (dt, dt / 2))
    return fine + (fine - coarse) / 3 if not body.floor else fine  # contact begins at no step's end: order 1 there


def elastic_forces(body: Body) -> Callable[[np.ndarray], np.ndarray]:
    """Positions [n, 3] -> forces of the material on all vertices [n, 3], N."""
    mesh, (mu, lam) = body.mesh, body.lame
    rest = mesh.vertices
    edges = np.swapaxes(rest[mesh.elements[:, 1:]] - rest[mesh.elements[:, :1]], 1, 2)
    inverse, volume = np.linalg.inv(edges), np.linalg.det(edges) / 6
    count, flat = len(rest), mesh.elements.ravel()

    def stress(F: np.ndarray) -> np.ndarray:
        if body.law == KIRCHHOFF:
            strain = 0.5 * (np.swapaxes(F, 1, 2) @ F - np.eye(3))
            return F @ (2 * mu * strain + lam * np.trace(strain, axis1=1, axis2=2)[:, None, None] * np.eye(3))
        cofactors = np.stack([np.cross(F[:, (i + 1) % 3], F[:, (i + 2) % 3]) for i in range(3)], axis=1)
        J = np.sum(F[:, 0] * cofactors[:, 0], axis=1)[:, None, None]
        if body.law == NEO_HOOKEAN:
            return mu * F + ((lam + mu) * (J - 1) - mu) * cofactors
        first, second = smith(mu, lam)
        return (
            first * (1 - 1 / (1 + np.sum(F**2, axis=(1, 2))))[:, None, None] * F
            + (second * (J - 1) - 0.75 * first) * cofactors
        )

    def forces(x: np.ndarray) -> np.ndarray:
        F = np.swapaxes(x[mesh.elements[:, 1:]] - x[mesh.elements[:, :1]], 1, 2) @ inverse
        corners = -volume[:, None, None] * (stress(F) @ np.swapaxes(inverse, 1, 2))
        all_corners = np.concatenate([-corners.sum(axis=2, keepdims=True), corners], axis=2)
        values = np.swapaxes(all_corners, 1, 2).reshape(-1, 3)
        return np.stack([np.bincount(flat, values[:, i], count) for i in range(3)], axis=1)

    return forces


def smith(mu: Any, lam: Any) -> tuple[Any, Any]:
    """The parameters of Smith's law that has the Lame parameters mu and lambda at small strains, Pa."""
    return 4 / 3 * mu, lam + 5 / 6 * mu


def _explicit(body: Body, dt: float, stiffness: float) -> np.ndarray:
    rest, masses, forces = body.mesh.vertices, lumped_masses(body.mesh, DENSITY)[:, None], elastic_forces(body)
    free = np.ones((len(rest), 1))
    free[body.held] = 0.0

    def acceleration(x: np.ndarray) -> np.ndarray:
        total = forces(x)
        if body.floor:
            total[:, 2] += stiffness * np.maximum(-x[:, 2], 0.0)
        return free * (total / masses - [0.0, 0.0, GRAVITY])

    x, v, out = rest.copy(), free * (body.v + np.zeros_like(rest)), []
    a, done = acceleration(x), 0
    for end in np.round(body.times / dt).astype(int):
        for _ in range(end - done):
            v = v + 0.5 * dt * a
            x = x + dt * v
            a = acceleration(x)
            v = v + 0.5 * dt * a
        done = end
        out.append(x)
    return np.array(out)
