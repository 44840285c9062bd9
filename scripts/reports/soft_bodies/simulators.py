"""Motions of a body by other simulators, as far as they are installed.

MuJoCo's flexes are bodies with three slide joints for every vertex, and linear tetrahedra between them. The stable
neo-Hookean law needs the integrator `discrete` (one linearised implicit step, no iteration of it); the default
St. Venant-Kirchhoff law also runs with the others. A flex has no derivatives but finite differences.

Newton runs on a processor, in single precision. Vertex block descent (Chen et al. 2024) takes steps of backward Euler
by a fixed number of sweeps over the vertices, and has no gradients. `SolverSemiImplicit` takes symplectic Euler steps
of Smith's law with the logarithm, with derivatives by Warp's tape, which keeps the states of all steps.
"""

import functools
import importlib
import itertools
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from dln_jax.softbody.mesh.mesh import components, lumped_masses
from scripts.reports.soft_bodies.body import DENSITY, GRAVITY, KIRCHHOFF, Body, Run, measured, smith

RADIUS = 1e-4
"""Radius of MuJoCo's vertices, m; the floor is lowered by it."""


@functools.cache
def simulator(name: str) -> Any:
    """The module of a simulator; prints a line and returns `None` if it is missing."""
    try:
        return importlib.import_module(name)
    except ImportError:
        print(f"{name} is missing, and so are its rows; pip install 'dln-jax[rivals]'")
        return None


def flex_model(body: Body, integrator: str, dt: float, solref: tuple[float, float]) -> Any:
    """MuJoCo's model of the body."""
    mujoco = simulator("mujoco")
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


def flex_motion(
    body: Body, integrator: str, dt: float, solref: tuple[float, float] = (0.02, 1.0), repetitions: int = 2
) -> Run:
    """A motion by MuJoCo with steps of dt in s; `solref` of contacts is MuJoCo's default."""
    mujoco, model = simulator("mujoco"), flex_model(body, integrator, dt, solref)
    free = np.setdiff1d(np.arange(len(body.mesh.vertices)), body.held)

    def run():
        data, out = mujoco.MjData(model), []
        data.qvel = (body.v + np.zeros_like(body.mesh.vertices))[free].ravel()
        for count in np.diff(body.ends(dt), prepend=0):
            mujoco.mj_step(model, data, int(count))
            x = body.mesh.vertices.copy()
            x[free] += data.qpos.reshape(-1, 3)
            out.append(x)
        return np.array(out)

    return measured(body, run, repetitions)


def newton_builder(body: Body, moduli: tuple[float, float]) -> Any:
    """Newton's model of the body; its solvers read the two moduli in Pa differently."""
    warp, builder = simulator("warp"), simulator("newton").ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
    vector = warp.vec3
    builder.add_soft_mesh(
        pos=vector(0.0, 0.0, 0.0),
        rot=warp.quat_identity(),
        scale=1.0,
        vel=vector(0.0, 0.0, 0.0),
        vertices=[vector(*place) for place in body.mesh.vertices],
        indices=body.mesh.elements.ravel().tolist(),
        density=DENSITY,
        k_mu=moduli[0],
        k_lambda=moduli[1],
        k_damp=0.0,
        particle_radius=0.0,
        add_surface_mesh_edges=body.near > 0,
    )
    builder.particle_qd = [vector(*v) for v in body.v + np.zeros_like(body.mesh.vertices)]
    for vertex in body.held:
        builder.particle_mass[vertex] = 0.0
    return builder


def stepped(model: Any, body: Body, dt: float, step: Callable[[Any, Any], None], repetitions: int = 2) -> Run:
    """A motion by Newton's step(now, after) with steps of dt in s."""

    def run():
        now, after, out = model.state(), model.state(), []
        for count in np.diff(body.ends(dt), prepend=0):
            for _ in range(count):
                now.clear_forces()
                step(now, after)
                now, after = after, now
            out.append(now.particle_q.numpy().astype(float))
        return np.array(out)

    return measured(body, run, repetitions)


def vbd_motion(body: Body, dt: float, iterations: int, stiffness: float = 1e3, repetitions: int = 2) -> Run:
    """A motion by vertex block descent; the stiffness of contact in N/m is Newton's default."""
    newton, builder = simulator("newton"), newton_builder(body, body.lame)
    builder.default_shape_cfg.ke, builder.default_shape_cfg.kd, builder.default_shape_cfg.mu = stiffness, 0.0, 0.0
    if body.floor:
        builder.add_ground_plane()
    builder.color()
    model = builder.finalize(device="cpu")
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = stiffness, 0.0, 0.0
    touching = {"particle_enable_self_contact": True, "particle_self_contact_margin": body.near}
    touching |= {"particle_self_contact_gap": body.near}
    options = {"iterations": iterations, "particle_enable_tile_solve": False, **(touching if body.near else {})}
    solver = newton.solvers.SolverVBD(model, **options)
    pipeline = newton.CollisionPipeline(model)
    contacts, control = pipeline.contacts(), model.control()

    def step(now, after):
        if body.floor or body.near:
            pipeline.collide(now, contacts)
        solver.step(now, after, control, contacts, dt)

    return stepped(model, body, dt, step, repetitions)


def explicit_motion(body: Body, dt: float) -> Run:
    """A motion by Newton's `SolverSemiImplicit`."""
    model = newton_builder(body, smith(*body.lame)).finalize(device="cpu")
    solver, control = simulator("newton").solvers.SolverSemiImplicit(model), model.control()
    return stepped(model, body, dt, lambda now, after: solver.step(now, after, control, None, dt))


def explicit_gradient(body: Body, dt: float) -> tuple[Run, float]:
    """Derivative of the mean height at the end by Young's modulus, in m/Pa, and central differences of motions.

    The differences are for a relative change that suits single precision.
    """
    warp, moduli = simulator("warp"), smith(*body.lame)
    model = newton_builder(body, moduli).finalize(device="cpu", requires_grad=True)
    solver, control = simulator("newton").solvers.SolverSemiImplicit(model), model.control()
    states = [model.state(requires_grad=True) for _ in range(int(body.ends(dt)[-1]) + 1)]
    mean = warp.array([(0.0, 0.0, 1.0 / model.particle_count)] * model.particle_count, dtype=warp.vec3)

    def slope():
        with warp.Tape() as tape:
            for now, after in itertools.pairwise(states):
                now.clear_forces()
                solver.step(now, after, control, None, dt)
        tape.backward(grads={states[-1].particle_q: mean})
        by_moduli = model.tet_materials.grad.numpy()[:, :2].astype(float).sum(axis=0)
        tape.zero()
        return by_moduli @ moduli / body.modulus  # both are proportional to Young's modulus

    end, change = body._replace(times=body.times[-1:]), 1e-2
    ends = (end._replace(modulus=factor * body.modulus) for factor in (1 + change, 1 - change))
    up, down = (explicit_motion(end, dt).x[-1, :, 2].mean() for end in ends)
    return measured(body, slope), float(up - down) / (2 * change * body.modulus)
