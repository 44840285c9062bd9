# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""Newton on a processor, in single precision, as Newton has it.

Vertex block descent (Chen et al. 2024) takes steps of backward Euler by a fixed number of sweeps over the vertices, and
has no gradients. `SolverSemiImplicit` takes symplectic Euler steps of Smith's law with the logarithm, with derivatives
by Warp's tape, which keeps the states of all steps.
"""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

wp.config.quiet = True

import newton  # noqa: E402

from scripts.reports.soft_bodies.body import DENSITY, GRAVITY, Body, Run, measured, smith  # noqa: E402


@wp.kernel
def same_material(parameters: wp.array[float], materials: wp.array2d[float]):
    """Gives all tetrahedra these parameters."""
    place = wp.tid()
    materials[place, 0] = parameters[0]
    materials[place, 1] = parameters[1]


@wp.kernel
def mean_height(q: wp.array[wp.vec3], mean: wp.array[float]):
    """Adds up the mean height."""
    place = wp.tid()
    wp.atomic_add(mean, 0, q[place][2] / float(q.shape[0]))


def builder_of(body: Body, moduli: tuple[float, float]) -> newton.ModelBuilder:
    """A model with the body; solvers read the two moduli in Pa differently."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
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
    return builder


def stepped(model: Any, body: Body, dt: float, step: Callable[[Any, Any], None], repetitions: int = 2) -> Run:
    """A motion by step(now, after) with steps of dt in s."""

    def run() -> np.ndarray:
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
    builder = builder_of(body, body.lame)
    builder.default_shape_cfg.ke, builder.default_shape_cfg.kd, builder.default_shape_cfg.mu = stiffness, 0.0, 0.0
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

    def step(now: Any, after: Any) -> None:
        if body.floor or body.near:
            pipeline.collide(now, contacts)
        solver.step(now, after, control, contacts, dt)

    return stepped(model, body, dt, step, repetitions)


def explicit_motion(body: Body, dt: float) -> Run:
    """A motion by `SolverSemiImplicit`."""
    model = builder_of(body, smith(*body.lame)).finalize(device="cpu")
    solver, control = newton.solvers.SolverSemiImplicit(model), model.control()
    return stepped(model, body, dt, lambda now, after: solver.step(now, after, control, None, dt))


def explicit_gradient(body: Body, dt: float) -> tuple[Run, float]:
    """Derivative of the mean height at the end by Young's modulus, in m/Pa, and central differences of motions.

    The differences are for a relative change that suits single precision.
    """
    both = np.array(smith(*body.lame))
    model = builder_of(body, smith(*body.lame)).finalize(device="cpu", requires_grad=True)
    solver, control = newton.solvers.SolverSemiImplicit(model), model.control()
    states = [model.state(requires_grad=True) for _ in range(int(body.ends(dt)[-1]) + 1)]
    parameters = wp.array(both, dtype=float, requires_grad=True)
    mean = wp.zeros(1, dtype=float, requires_grad=True)

    def slope() -> Any:
        mean.zero_()
        with wp.Tape() as tape:
            wp.launch(same_material, model.tet_count, [parameters], [model.tet_materials])
            for now, after in itertools.pairwise(states):
                now.clear_forces()
                solver.step(now, after, control, None, dt)
            wp.launch(mean_height, model.particle_count, [states[-1].particle_q], [mean])
        tape.backward(mean)
        by_parameters = parameters.grad.numpy().astype(float)
        tape.zero()
        return by_parameters @ both / body.modulus  # both parameters are proportional to Young's modulus

    end, change = body._replace(times=body.times[-1:]), 1e-2
    ends = (end._replace(modulus=factor * body.modulus) for factor in (1 + change, 1 - change))
    up, down = (explicit_motion(end, dt).x[-1, :, 2].mean() for end in ends)
    return measured(body, slope), float(up - down) / (2 * change * body.modulus)
