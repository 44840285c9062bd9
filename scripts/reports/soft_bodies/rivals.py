"""Speed against error of this library and of the simulators that can be imported, on one processor.

All have the same mesh, lumped masses, load and material. Errors of motions on one mesh are those of the displacement
against `reference_motion`: what remains are time steps, solvers and contact. Processor time leaves compilation out. Set
OPENBLAS_NUM_THREADS=1: waiting threads would count.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.softbody.contact.crossings import crossings
from dln_jax.softbody.contact.distances import POINT_TRIANGLE, squared_distance
from dln_jax.softbody.mesh.mesh import Mesh, boundary, components, lumped_masses, vertices_where
from dln_jax.softbody.mesh.shapes import box, join, quadratic, rotate, translate
from scripts.reports.run import Numbers
from scripts.reports.soft_bodies.body import (
    DENSITY,
    GRAVITY,
    KIRCHHOFF,
    NEO_HOOKEAN,
    SMITH,
    Body,
    Run,
    elastic_forces,
    gradient,
    motion,
    program,
    reference_motion,
    relative_error,
)
from scripts.reports.soft_bodies.simulators import (
    explicit_gradient,
    explicit_motion,
    flex_motion,
    simulator,
    vbd_motion,
)

LENGTHS = (1.0, 0.25, 0.25)
STEP = 2e-3
"""Time step of blocks in contact, s."""


def cantilever(cells: int, *, moments: int = 5, order: int = 1, law: str = NEO_HOOKEAN) -> Body:
    """A cantilever of 1 m with this number of cells through its thickness, E = 1e6 Pa; 0.1 s between the moments."""
    mesh = box(LENGTHS, (4 * cells, cells, cells))
    mesh = quadratic(mesh) if order == 2 else mesh
    held = vertices_where(mesh, lambda x: x[:, 0] == 0)
    return Body(mesh, held, 1e6, 0.1 * np.arange(1, 1 + moments), law=law)


def errors_of(name: str, body: Body, runs: dict[str, Run], reference: np.ndarray) -> dict[str, dict[str, float]]:
    """Error and times of runs by SIMULATOR/STEP."""
    return {
        f"rivals/{name}/{key}": {
            "error": relative_error(body, run.x, reference),
            "processor_seconds_per_second": run.seconds,
            "compile_seconds": run.compiling,
        }
        for key, run in runs.items()
    }


def swing(*, moments: int = 5) -> Numbers:
    """A cantilever released from rest; its tip falls by 0.38 m."""
    body, steps = cantilever(3, moments=moments), (0.02, 0.01, 0.005, 0.002)
    runs = {f"{rule}/{dt}": motion(body, rule, dt) for rule in ("backward-euler", "midpoint") for dt in steps}
    kirchhoff, smith = body._replace(law=KIRCHHOFF), body._replace(law=SMITH)
    others: dict[str, tuple[Body, dict[str, Run]]] = {}
    if simulator("mujoco"):
        runs |= {f"mujoco-discrete/{dt}": flex_motion(body, "discrete", dt) for dt in (0.01, 0.005, 0.002, 5e-4, 1e-4)}
        own = {f"mujoco-euler/{dt}": flex_motion(kirchhoff, "Euler", dt) for dt in (1e-3, 5e-4, 1e-4)}
        others["mujoco"] = kirchhoff, own
    if simulator("newton"):
        tried = ((10, 0.01), (10, 0.002), (10, 5e-4), (50, 0.01), (50, 0.002))
        runs |= {f"newton-{sweeps}/{dt}": vbd_motion(body, dt, sweeps) for sweeps, dt in tried}
        others["newton"] = smith, {f"newton-explicit/{dt}": explicit_motion(smith, dt) for dt in (1e-3, 5e-4)}
    numbers = errors_of("swing", body, runs, reference_motion(body, 2e-4))
    # Explicit methods of rivals run other laws only, and are compared with references of these.
    for other, own in others.values():
        numbers |= errors_of("swing", other, own, reference_motion(other, 2e-4))
    return numbers


def drop(*, moments: int = 5) -> Numbers:
    """A cube of 0.5 m, E = 1e5 Pa, falls by 0.1 m on a rigid floor without friction and rebounds.

    The reference's floor is a penalty of 1e7 N/m for each vertex. Another of 1e6 N/m says how much of an error is
    only a matter of how a contact is modelled.
    """
    mesh = box((0.5, 0.5, 0.5), (4, 4, 4))
    mesh = mesh._replace(vertices=mesh.vertices + np.array([0.0, 0.0, 0.1]))
    body = Body(mesh, np.zeros(0, int), 1e5, 0.1 * np.arange(1, 1 + moments), floor=True)
    tried = (("backward-euler", (0.01, 0.002)), ("bdf2", (0.01, 0.005, 0.002)))
    runs = {f"{rule}/{dt}": motion(body, rule, dt) for rule, steps in tried for dt in steps}
    if simulator("mujoco"):
        runs |= {f"mujoco-discrete/{dt}": flex_motion(body, "discrete", dt) for dt in (0.01, 0.002, 5e-4)}
        stiff = {dt: flex_motion(body, "discrete", dt, (2 * dt, 1.0)) for dt in (0.002, 5e-4)}
        runs |= {f"mujoco-stiff-contact/{dt}": run for dt, run in stiff.items()}
    if simulator("newton"):
        runs |= {f"newton-10/{dt}": vbd_motion(body, dt, 10) for dt in (0.002, 5e-4)}
        runs["newton-10-stiff-contact/0.002"] = vbd_motion(body, 0.002, 10, 1e6)
    reference = reference_motion(body, 1e-4, 1e7)
    softer = relative_error(body, reference_motion(body, 2e-4, 1e6), reference)
    return {**errors_of("drop", body, runs, reference), "rivals/drop/reference": {"by_floor": softer}}


def mesh_error(*, moments: int = 5) -> Numbers:
    """Linear elements of all simulators and quadratic ones of this library, against a fine mesh in short steps."""
    numbers = {}
    for law in (NEO_HOOKEAN, KIRCHHOFF):
        body = functools.partial(cantilever, moments=moments, law=law)
        runs: dict[str, tuple[Body, Run]] = {}
        for cells in (3, 6):
            linear = body(cells)
            if law == NEO_HOOKEAN:
                runs[f"dln_jax/linear/{cells}"] = linear, motion(linear, "midpoint", 0.01)
                if simulator("mujoco"):
                    runs[f"mujoco-discrete/linear/{cells}"] = linear, flex_motion(linear, "discrete", 0.002)
                if simulator("newton") and cells == 3:
                    runs[f"newton-10/linear/{cells}"] = linear, vbd_motion(linear, 0.002, 10)
                fine = body(cells // 3, order=2)
                runs[f"dln_jax/quadratic/{cells // 3}"] = fine, motion(fine, "midpoint", 0.01)
            elif simulator("mujoco"):
                runs[f"mujoco-euler/linear/{cells}"] = linear, flex_motion(linear, "Euler", 0.003 / cells)
        if not runs:
            continue
        finest = body(3, order=2)
        exact = common(finest, motion(finest, "midpoint", 0.005).x)
        for key, (shape, run) in runs.items():
            error = float(np.linalg.norm(common(shape, run.x) - exact) / np.linalg.norm(exact))
            numbers[f"rivals/mesh/{key}"] = {
                "error": error if np.isfinite(error) else np.inf,
                "processor_seconds_per_second": run.seconds,
            }
    return numbers


def common(body: Body, x: np.ndarray) -> np.ndarray:
    """Displacements [s, 16, 3] of the vertices that all meshes of the cantilever have in common."""
    places = box(LENGTHS, (4, 1, 1)).vertices
    places = places[places[:, 0] > 0]
    nearest = np.linalg.norm(body.mesh.vertices - places[:, None], axis=2).argmin(axis=1)
    return x[:, nearest] - body.mesh.vertices[nearest]


def motion_gradient(*, moments: int = 5) -> Numbers:
    """Derivative of the mean height at the end by Young's modulus, in reverse mode, and its error."""
    numbers = {}
    for law, suffix in ((NEO_HOOKEAN, ""), (SMITH, "-smith")):
        body, change = cantilever(3, moments=moments, law=law), 1e-4
        ends = (body._replace(modulus=f * 1e6, times=body.times[-1:]) for f in (1 + change, 1 - change))
        up, down = (reference_motion(end, 2e-4)[-1, :, 2].mean() for end in ends)
        exact, results = (up - down) / (2 * change * 1e6), {}
        for rule, dt in (("midpoint", 0.01), ("midpoint", 0.002), ("backward-euler", 0.01))[: 1 if suffix else 3]:
            run = program(body, rule, dt)
            results[f"{rule}{suffix}/{dt}"] = gradient(body, lambda params, run=run: run(params)[-1, :, 2].mean())
        if suffix and simulator("newton"):
            results |= {f"newton-explicit/{dt}": explicit_gradient(body, dt) for dt in (1e-3, 5e-4)}
        for key, (run, differences) in results.items():
            numbers[f"rivals/gradient/{key}"] = {
                "error": abs(float(run.x) / exact - 1),
                "error_of_differences": abs(float(run.x) / differences - 1),
                "processor_seconds_per_second": run.seconds,
            }
    return numbers


def blocks(*, rest_seconds: float = 1.0) -> Numbers:
    """A block of 0.2 m rests on one of 0.4 m, and hits it at 3 m/s; E = 1e5 Pa, steps of 2 ms, no friction.

    Positions alone are judged: moments with surfaces that cross, in rational arithmetic; the largest depth of a vertex
    of one block in the other; and the force that holds the lower block to the ground, less its weight.
    """
    numbers = {}
    for name, body in (("rest", resting(rest_seconds)), ("hit", hitting())):
        runs = {"dln_jax": motion(body, "backward-euler", STEP, repetitions=1)}
        if simulator("mujoco"):
            runs["mujoco-discrete"] = flex_motion(body, "discrete", STEP, repetitions=1)
            runs["mujoco-stiff-contact"] = flex_motion(body, "discrete", STEP, (2 * STEP, 1.0), repetitions=1)
        if simulator("newton"):
            runs["newton-10"] = vbd_motion(body, STEP, 10, repetitions=1)
            runs["newton-50-stiff-contact"] = vbd_motion(body, STEP, 50, 1e5, repetitions=1)
        upper = np.unique(body.mesh.elements[components(body.mesh) != components(body.mesh)[0]])
        weight = GRAVITY * lumped_masses(body.mesh, DENSITY)[upper].sum()
        for key, run in runs.items():
            finite = np.isfinite(run.x).all()
            row = {
                "crossings": sum(bool(crossings(body.mesh, x)) for x in run.x) if finite else np.inf,
                "deepest_metres": max(depth(body.mesh, x) for x in run.x),
                "processor_seconds_per_step": run.seconds * STEP,
            }
            if name == "rest":  # in the last quarter
                forces = np.array([force_on_lower(body, x) for x in run.x]) / weight
                row |= {"force_error": abs(forces.mean() - 1), "force_spread": forces.std()}
            numbers[f"rivals/blocks-{name}/{key}"] = row
    return numbers


def resting(seconds: float) -> Body:
    """The upper block is let go 6 mm above the lower one."""
    return two_blocks(np.linspace(0.75, 1.0, 26) * seconds, 0.0)


def hitting() -> Body:
    """The upper block is thrown at the lower one at 3 m/s; 0.1 s."""
    return two_blocks(STEP * np.arange(1, 51), 3.0)


def two_blocks(times: np.ndarray, speed: float) -> Body:
    """The upper block is smaller and turned about the vertical; surfaces repel each other from 5 mm on."""
    lower, upper = box((0.4, 0.4, 0.2), (4, 4, 2)), box((0.2, 0.2, 0.2), (3, 3, 3))
    upper = translate(rotate(upper, [0.0, 0.0, np.pi / 6], about=[0.1, 0.1, 0.0]), [0.1, 0.1, 0.206])
    mesh = join(lower, upper)
    v = np.where(np.arange(len(mesh.vertices))[:, None] >= len(lower.vertices), [0.0, 0.0, -speed], 0.0)
    held = vertices_where(mesh, lambda x: x[:, 2] == 0)
    return Body(mesh, held, 1e5, np.round(times / STEP) * STEP, near=5e-3, v=v)


def depth(mesh: Mesh, x: np.ndarray) -> float:
    """The largest depth of a vertex of one component in another, m."""
    number_of, skin, deepest = components(mesh), boundary(mesh), 0.0
    for part in range(number_of.max() + 1):
        mine = np.unique(mesh.elements[number_of == part])
        others, facets = mesh.elements[number_of != part], skin[~np.isin(skin[:, 0], mine)]
        points = np.intersect1d(mine, skin)
        of_points = np.repeat(x[points][:, None, None], len(facets), axis=1)
        of_facets = np.repeat(x[facets][None], len(points), axis=0)
        distances = np.sqrt(np.asarray(squares(np.concatenate([of_points, of_facets], axis=2)))).min(axis=1)
        edges = np.swapaxes(x[others[:, 1:]] - x[others[:, :1]], 1, 2)
        place = np.einsum("mij,pmj->pmi", np.linalg.inv(edges), x[points][:, None] - x[others[:, 0]])
        inside = ((place > 0).all(axis=2) & (place.sum(axis=2) < 1)).any(axis=1)
        deepest = max(deepest, float(distances[inside].max(initial=0.0)))
    return deepest


squares = jax.jit(jax.vmap(jax.vmap(lambda pair: squared_distance(pair, jnp.asarray(POINT_TRIANGLE)))))
"""Positions [points, facets, 4, 3] -> squared distances, m²."""


def force_on_lower(body: Body, x: np.ndarray) -> float:
    """Force of the upper block on the lower one if that is at rest, N: what holds it, less its weight."""
    masses = lumped_masses(body.mesh, DENSITY)
    lower = np.unique(body.mesh.elements[components(body.mesh) == components(body.mesh)[0]])
    holding = GRAVITY * masses[body.held].sum() - elastic_forces(body)(x)[body.held, 2].sum()
    return float(holding - GRAVITY * masses[lower].sum())
