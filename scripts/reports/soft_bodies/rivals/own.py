"""This library's side: time steps, a static solve and their gradients."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.rollout import rollout
from dln_jax.softbody.contact import body_contact
from dln_jax.softbody.equilibrium import static_solve
from dln_jax.softbody.integrators import INTEGRATORS
from dln_jax.softbody.mesh.simplices import determinant
from dln_jax.softbody.scene import Params, SoftScene, make_scene, with_parameters
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.contact import plane_contact
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.gravity import gravity
from dln_jax.softbody.terms.strain_energies import (
    DeformationGradient,
    squared_norm,
    st_venant_kirchhoff,
    stable_neo_hookean,
)
from dln_jax.types import Scalar
from scripts.reports.soft_bodies.rivals.body import (
    DENSITY,
    GRAVITY,
    KIRCHHOFF,
    NEO_HOOKEAN,
    SMITH,
    Body,
    Run,
    measured,
    smith,
)

FLOOR = 1e7
"""Stiffness of the floor, N/m for each vertex."""
BARRIER = 1e4
"""Stiffness of the barrier between bodies, Pa."""


def smith_neo_hookean(F: DeformationGradient, mu: Scalar, lam: Scalar) -> Scalar:
    """Smith's law with the logarithm: W = a/2 (I1 - 3 - ln(I1 + 1) + ln 4) - 3/4 a (J - 1) + b/2 (J - 1)²."""
    (first, second), change, square = smith(mu, lam), determinant(F) - 1, squared_norm(F)
    shear = 0.5 * first * (square - 3 - jnp.log((square + 1) / 4))
    return shear - 0.75 * first * change + 0.5 * second * change**2


LAWS = {NEO_HOOKEAN: stable_neo_hookean, KIRCHHOFF: st_venant_kirchhoff, SMITH: smith_neo_hookean}


def scene_of(body: Body) -> SoftScene:
    """The body's scene."""
    terms = [
        elastic(body.mesh, LAWS[body.law], youngs_modulus=body.modulus, poisson_ratio=body.ratio),
        gravity(body.mesh, (0.0, 0.0, -GRAVITY)),
    ]
    if body.floor:
        vertices = range(len(body.mesh.vertices))
        terms.append(plane_contact(vertices, normal=(0, 0, 1), stiffness=FLOOR, width=0.0))
    contacts = [body_contact(body.mesh, distance=body.near, stiffness=BARRIER)] if body.near else []
    return make_scene(body.mesh, terms, density=DENSITY, held=body.held, contacts=contacts)


def motion(body: Body, integrator: str, dt: float, repetitions: int = 2) -> Run:
    """A motion by one integrator with steps of dt in s; NaN if a step did not converge."""
    program = _program(body, integrator, dt)
    params = scene_of(body).params
    return measured(body, lambda: jax.block_until_ready(program(params)), repetitions)


def motion_gradient(body: Body, integrator: str, dt: float, change: float = 1e-4) -> tuple[Run, float, float]:
    """Derivative of the mean height at the end by Young's modulus, in m/Pa, by reverse mode.

    Returns its time and value, and central differences of the same program for a relative change of the modulus.
    """
    program, params = _program(body, integrator, dt), scene_of(body).params

    def height(modulus: Any) -> Any:
        return program(with_parameters(params, elastic={"youngs_modulus": modulus}))[-1, :, 2].mean()

    at, slope = jnp.asarray(body.modulus), jax.jit(jax.grad(height))
    differences = (height(at * (1 + change)) - height(at * (1 - change))) / (2 * change * at)
    run = measured(body, lambda: jax.block_until_ready(slope(at)))
    return run, float(run.x), float(differences)


def static(body: Body) -> Run:
    """Equilibrium under the weight; its time is that of one solve (`body.times` is one second)."""
    scene = scene_of(body)
    solve = jax.jit(lambda params: static_solve(scene, params)[0])
    return measured(body, lambda: jax.block_until_ready(solve(scene.params))[None])


def static_gradient(body: Body) -> tuple[Run, float]:
    """Derivative of the mean height at equilibrium by Young's modulus, in m/Pa."""
    scene = scene_of(body)

    @jax.jit
    def slope(modulus: Any) -> Any:
        def height(E: Any) -> Any:
            return static_solve(scene, with_parameters(scene.params, elastic={"youngs_modulus": E}))[0][:, 2].mean()

        return jax.grad(height)(modulus)

    at = jnp.asarray(body.modulus)
    return measured(body, lambda: jax.block_until_ready(slope(at))), float(slope(at))


def _program(body: Body, integrator: str, dt: float) -> Any:
    """params -> positions at the body's times, compiled."""
    scene = scene_of(body)
    init, step = make_step(scene, dt, INTEGRATORS[integrator])
    ends = np.round(body.times / dt).astype(int)
    observe = lambda state, info: (state.x, info.converged)  # noqa: E731

    @jax.jit
    def run(params: Params) -> Any:
        x, converged = rollout(partial(step, params), init(v=body.v), steps=int(ends[-1]), observe=observe)[1]
        return jnp.where(converged.all(), x[ends - 1], jnp.nan)

    return run
