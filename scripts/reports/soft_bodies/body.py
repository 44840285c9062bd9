"""The body that all simulators receive, its motion by this library, and a reference that shares no code with any.

The reference integrates M a = f(x) with Störmer and Verlet's explicit method (order 2) in NumPy, with the first
Piola-Kirchhoff stress of the material written out, and extrapolates two step lengths. It damps nothing.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from dln_jax.rollout import rollout
from dln_jax.softbody.contact.bodies import body_contact
from dln_jax.softbody.integrators import INTEGRATORS
from dln_jax.softbody.mesh.mesh import Mesh, lumped_masses
from dln_jax.softbody.mesh.simplices import determinant
from dln_jax.softbody.scene import Params, SoftScene, make_scene, with_parameters
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.contact import plane_contact
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.loads import gravity
from dln_jax.softbody.terms.strain_energies import (
    DeformationGradient,
    squared_norm,
    st_venant_kirchhoff,
    stable_neo_hookean,
)
from dln_jax.types import Scalar

GRAVITY, DENSITY = 9.81, 1000.0
NEO_HOOKEAN, KIRCHHOFF, SMITH = "stable neo-Hookean", "St. Venant-Kirchhoff", "Smith's neo-Hookean"
"""Laws; the last is Smith et al.'s (2018) with the logarithm, whose parameters are 4/3 mu and lambda + 5/6 mu."""


class Body(NamedTuple):
    """Bodies that start under their weight, perhaps above a rigid floor z = 0 or each other, without friction."""

    mesh: Mesh
    held: Int[np.ndarray, " k"]
    modulus: float
    """Young's modulus, Pa; Poisson's ratio is 0.3."""
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
        return self.modulus / 2.6, 0.3 * self.modulus / (1.3 * 0.4)

    def ends(self, dt: float) -> Int[np.ndarray, " s"]:
        """Numbers of the steps of dt in s that end at the times."""
        return np.round(self.times / dt).astype(int)


class Run(NamedTuple):
    """A result of one simulator with one setting."""

    x: Any
    """Positions at the body's times, or a derivative."""
    seconds: float
    """Processor time per simulated second, s, without compilation."""
    compiling: float
    """Elapsed time until the first result, less that of a second run, s."""


def measured(body: Body, run: Callable[[], Any], repetitions: int = 2) -> Run:
    """Times a function: a first call compiles, the fastest of the others counts; calls above 2 s are not repeated."""
    began = time.perf_counter()
    run()
    first = time.perf_counter() - began
    taken, elapsed, x = [], [], None
    while len(taken) < repetitions and not (taken and taken[-1] > 2.0):
        began, start = time.perf_counter(), time.process_time()
        x = np.asarray(run())
        taken.append(time.process_time() - start)
        elapsed.append(time.perf_counter() - began)
    return Run(x, min(taken) / float(body.times[-1]), max(first - min(elapsed), 0.0))


def relative_error(body: Body, x: Float[np.ndarray, "s n 3"], reference: Float[np.ndarray, "s n 3"]) -> float:
    """Norm of the difference over that of the displacement, weighted by mass, over all times; inf if not finite."""
    weights = lumped_masses(body.mesh, DENSITY)[:, None]
    squares = [float(np.sum(weights * d**2)) for d in (x - reference, reference - body.mesh.vertices)]
    error = np.sqrt(squares[0] / squares[1])
    return float(error) if np.isfinite(error) else float("inf")


def reference_motion(body: Body, dt: float, stiffness: float = 1e7) -> Float[np.ndarray, "s n 3"]:
    """Positions at `body.times`, extrapolated from steps of dt and dt/2 in s; the floor is a penalty in N/m."""
    coarse, fine = (explicit(body, step, stiffness) for step in (dt, dt / 2))
    return fine + (fine - coarse) / 3 if not body.floor else fine  # contact begins at no step's end: order 1 there


def elastic_forces(body: Body) -> Callable[[np.ndarray], np.ndarray]:
    """Positions [n, 3] -> forces of the material on all vertices [n, 3], N."""
    mesh, (mu, lam) = body.mesh, body.lame
    rest = mesh.vertices
    edges = np.swapaxes(rest[mesh.elements[:, 1:]] - rest[mesh.elements[:, :1]], 1, 2)
    inverse, volume = np.linalg.inv(edges), np.linalg.det(edges) / 6
    first, second = smith(mu, lam)

    def stress(F):
        if body.law == KIRCHHOFF:
            strain = 0.5 * (np.swapaxes(F, 1, 2) @ F - np.eye(3))
            return F @ (2 * mu * strain + lam * np.trace(strain, axis1=1, axis2=2)[:, None, None] * np.eye(3))
        cofactors = np.stack([np.cross(F[:, (i + 1) % 3], F[:, (i + 2) % 3]) for i in range(3)], axis=1)
        J = np.sum(F[:, 0] * cofactors[:, 0], axis=1)[:, None, None]
        if body.law == NEO_HOOKEAN:
            return mu * F + ((lam + mu) * (J - 1) - mu) * cofactors
        shear = first * (1 - 1 / (1 + np.sum(F**2, axis=(1, 2))))[:, None, None] * F
        return shear + (second * (J - 1) - 0.75 * first) * cofactors

    def forces(x):
        F = np.swapaxes(x[mesh.elements[:, 1:]] - x[mesh.elements[:, :1]], 1, 2) @ inverse
        corners = -volume[:, None, None] * (stress(F) @ np.swapaxes(inverse, 1, 2))
        all_corners = np.concatenate([-corners.sum(axis=2, keepdims=True), corners], axis=2)
        values = np.swapaxes(all_corners, 1, 2).reshape(-1, 3)
        return np.stack([np.bincount(mesh.elements.ravel(), values[:, i], len(rest)) for i in range(3)], axis=1)

    return forces


def smith(mu, lam):
    """The parameters of Smith's law that has the Lame parameters mu and lambda at small strains, Pa."""
    return 4 / 3 * mu, lam + 5 / 6 * mu


def explicit(body: Body, dt: float, stiffness: float) -> np.ndarray:
    """Positions at the body's times by Störmer and Verlet's method."""
    rest, masses, forces = body.mesh.vertices, lumped_masses(body.mesh, DENSITY)[:, None], elastic_forces(body)
    free = np.ones((len(rest), 1))
    free[body.held] = 0.0

    def acceleration(x):
        total = forces(x)
        if body.floor:
            total[:, 2] += stiffness * np.maximum(-x[:, 2], 0.0)
        return free * (total / masses - [0.0, 0.0, GRAVITY])

    x, v, out = rest.copy(), free * (body.v + np.zeros_like(rest)), []
    a = acceleration(x)
    for count in np.diff(body.ends(dt), prepend=0):
        for _ in range(count):
            v = v + 0.5 * dt * a
            x = x + dt * v
            a = acceleration(x)
            v = v + 0.5 * dt * a
        out.append(x)
    return np.array(out)


def smith_neo_hookean(F: DeformationGradient, mu: Scalar, lam: Scalar) -> Scalar:
    """Smith's law with the logarithm: W = a/2 (I1 - 3 - ln(I1 + 1) + ln 4) - 3/4 a (J - 1) + b/2 (J - 1)²."""
    (first, second), change, square = smith(mu, lam), determinant(F) - 1, squared_norm(F)
    shear = 0.5 * first * (square - 3 - jnp.log((square + 1) / 4))
    return shear - 0.75 * first * change + 0.5 * second * change**2


LAWS = {NEO_HOOKEAN: stable_neo_hookean, KIRCHHOFF: st_venant_kirchhoff, SMITH: smith_neo_hookean}


def scene_of(body: Body) -> SoftScene:
    """The body's scene, with a floor of 1e7 N/m for each vertex and a barrier of 1e4 Pa between bodies."""
    terms = [
        elastic(body.mesh, LAWS[body.law], youngs_modulus=body.modulus, poisson_ratio=0.3),
        gravity(body.mesh, (0.0, 0.0, -GRAVITY)),
    ]
    if body.floor:
        vertices = range(len(body.mesh.vertices))
        terms.append(plane_contact(vertices, normal=(0, 0, 1), stiffness=1e7, width=0.0))
    contacts = [body_contact(body.mesh, distance=body.near, stiffness=1e4)] if body.near else []
    return make_scene(body.mesh, terms, density=DENSITY, held=body.held, contacts=contacts)


def motion(body: Body, integrator: str, dt: float, repetitions: int = 2) -> Run:
    """A motion by one integrator with steps of dt in s; NaN if a step did not converge."""
    run, params = program(body, integrator, dt), scene_of(body).params
    return measured(body, lambda: jax.block_until_ready(run(params)), repetitions)


def program(body: Body, integrator: str, dt: float) -> Callable[[Params], Any]:
    """params -> positions at the body's times, compiled."""
    init, step = make_step(scene_of(body), dt, INTEGRATORS[integrator])
    ends = body.ends(dt)
    observe = lambda state, info: (state.x, info.converged)  # noqa: E731

    @jax.jit
    def run(params):
        x, converged = rollout(partial(step, params), init(v=body.v), steps=int(ends[-1]), observe=observe)[1]
        return jnp.where(converged.all(), x[ends - 1], jnp.nan)

    return run


def gradient(body: Body, height: Callable[[Params], Any]) -> tuple[Run, float]:
    """Time and value of the derivative of a height, m/Pa, by Young's modulus, and central differences of it."""
    params, at, change = scene_of(body).params, jnp.asarray(body.modulus), 1e-4

    def of_modulus(modulus):
        return height(with_parameters(params, elastic={"youngs_modulus": modulus}))

    slope = jax.jit(jax.grad(of_modulus))
    differences = (of_modulus(at * (1 + change)) - of_modulus(at * (1 - change))) / (2 * change * at)
    return measured(body, lambda: jax.block_until_ready(slope(at))), float(differences)
