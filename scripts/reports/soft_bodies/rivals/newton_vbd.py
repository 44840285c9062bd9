# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""Newton's vertex block descent (Chen et al. 2024) on a processor, in single precision, as Newton has it.

A step is backward Euler, by a fixed number of sweeps over the vertices. `SolverVBD` has no gradients.
"""

import numpy as np
import warp as wp

wp.config.quiet = True

import newton  # noqa: E402

from scripts.reports.soft_bodies.rivals.body import DENSITY, GRAVITY, Body, Run, measured  # noqa: E402

VERSION = newton.__version__


def add_body(builder: newton.ModelBuilder, body: Body, moduli: tuple[float, float]) -> None:
    """Adds a body and holds its held vertices; solvers read the two moduli in Pa differently."""
    builder.add_soft_mesh(
        pos=wp.vec3(0.0, 0.0, 0.0),
        rot=wp.quat_identity(),
        scale=1.0,
        vel=wp.vec3(0.0, 0.0, 0.0),
        vertices=[wp.vec3(*place) for place in body.mesh.vertices],
        indices=body.mesh.elements.ravel().tolist(),
        density=DENSITY,
        k_mu=moduli[0],
        k_lambda=moduli[1],
        k_damp=0.0,
        particle_radius=0.0,
        add_surface_mesh_edges=body.near > 0,
    )
    for vertex in body.held:
        builder.particle_mass[vertex] = 0.0


def motion(body: Body, dt: float, iterations: int, stiffness: float = 1e3, repetitions: int = 2) -> Run:
    """A motion with steps of dt in s; the stiffness of contact in N/m is Newton's default."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
    builder.default_shape_cfg.ke, builder.default_shape_cfg.kd, builder.default_shape_cfg.mu = stiffness, 0.0, 0.0
    add_body(builder, body, body.lame)
    builder.particle_qd = [wp.vec3(*v) for v in body.v + np.zeros_like(body.mesh.vertices)]
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
    ends = np.round(body.times / dt).astype(int)

    def run() -> np.ndarray:
        now, after, out = model.state(), model.state(), []
        for count in np.diff(ends, prepend=0):
            for _ in range(count):
                now.clear_forces()
                if body.floor or body.near:
                    pipeline.collide(now, contacts)
                solver.step(now, after, control, contacts, dt)
                now, after = after, now
            out.append(now.particle_q.numpy().astype(float))
        return np.array(out)

    return measured(body, run, repetitions)
