# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""MuJoCo's flexes: a body with three slide joints for every vertex, and linear tetrahedra between them.

The stable neo-Hookean law needs the integrator `discrete` (one linearised implicit step, no iteration of it); the
default St. Venant-Kirchhoff law also runs with the others. A flex has no derivatives but finite differences.
"""

import warnings
from typing import Any

import mujoco
import numpy as np

from dln_jax.softbody.mesh import lumped_masses
from dln_jax.softbody.mesh.mesh import components
from scripts.reports.soft_bodies.body import DENSITY, GRAVITY, KIRCHHOFF, Body, Run, measured

RADIUS = 1e-4
"""Radius of the vertices, m; the floor is lowered by it."""


def model_of(body: Body, integrator: str, dt: float, solref: tuple[float, float]) -> Any:
    """The compiled model."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = dt, [0.0, 0.0, -GRAVITY]
    spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    masses, held = lumped_masses(body.mesh, DENSITY), set(body.held.tolist())
    for i, (place, mass) in enumerate(zip(body.mesh.vertices, masses, strict=True)):
        part = spec.worldbody.add_body(name=f"v{i}", pos=place, mass=mass, inertia=[mass * 1e-6] * 3)
        part.explicitinertial = True
        for axis in np.eye(3) if i not in held else ():
            part.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
    number = components(body.mesh)
    for part in range(number.max() + 1):
        elements = body.mesh.elements[number == part]
        mine = np.unique(elements)
        flex = spec.add_flex(name=f"body{part}", dim=3, radius=RADIUS, young=body.modulus, poisson=0.3, condim=1)
        flex.elastic3d = int(body.law != KIRCHHOFF)
        flex.selfcollide = mujoco.mjtFlexSelf.mjFLEXSELF_NONE
        flex.vertbody = [f"v{i}" for i in mine]
        flex.elem = np.searchsorted(mine, elements).ravel().tolist()
        flex.solref = solref
        flex.margin = body.near / 2  # margins of two flexes add up
    if body.floor:
        floor = {"pos": [0.0, 0.0, -RADIUS], "size": [5.0, 5.0, 0.1], "condim": 1, "solref": solref}
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, **floor)
    with warnings.catch_warnings():  # MuJoCo 4.0 warns that a stable neo-Hookean flex has no passive forces; it has
        warnings.simplefilter("ignore")
        return spec.compile()


def motion(
    body: Body, integrator: str, dt: float, solref: tuple[float, float] = (0.02, 1.0), repetitions: int = 2
) -> Run:
    """A motion with steps of dt in s; `solref` of contacts is MuJoCo's default."""
    model = model_of(body, integrator, dt, solref)
    free = np.setdiff1d(np.arange(len(body.mesh.vertices)), body.held)

    def run() -> np.ndarray:
        data, out = mujoco.MjData(model), []
        data.qvel = (body.v + np.zeros_like(body.mesh.vertices))[free].ravel()
        for count in np.diff(body.ends(dt), prepend=0):
            mujoco.mj_step(model, data, int(count))
            x = body.mesh.vertices.copy()
            x[free] += data.qpos.reshape(-1, 3)
            out.append(x)
        return np.array(out)

    return measured(body, run, repetitions)
