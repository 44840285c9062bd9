"""Two blocks in contact, by this library and its rivals: how deep surfaces penetrate, and what force they transmit.

The lower block stands on the ground; the upper one is smaller, turned about the vertical, and is let go above it or
thrown onto it. Whatever the simulator, positions alone are judged: surfaces that cross, in rational arithmetic; the
largest depth of a vertex of one block in the other; and the force that holds the lower block to the ground, less its
weight, from the stresses of its elements.
"""

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.softbody.contact import crossings
from dln_jax.softbody.contact.distances import POINT_TRIANGLE, squared_distance
from dln_jax.softbody.mesh.mesh import Mesh, boundary, components, lumped_masses, make_mesh, vertices_where
from dln_jax.softbody.mesh.shapes import box
from scripts.reports.case import Findings
from scripts.reports.rows import Row, expect
from scripts.reports.soft_bodies.rivals import own
from scripts.reports.soft_bodies.rivals.body import DENSITY, GRAVITY, Body, Run, elastic_forces
from scripts.reports.soft_bodies.rivals.simulators import number, rivals

STEP, NEAR = 2e-3, 5e-3
"""Time step, s, and largest distance of surfaces that repel each other, m."""


def blocks(quick: bool) -> Findings:
    """A block of 0.2 m rests on one of 0.4 m after 1 s, and hits it at 3 m/s; E = 1e5 Pa, nu = 0.3, no friction."""
    rest, hit = resting(0.5 if quick else 1.0), hitting()
    simulators, missing = rivals()
    rows = []
    for body, name in ((rest, "rest"), (hit, "hit")):
        once = {"repetitions": 1}
        runs = {"dln_jax": own.motion(body, "backward-euler", STEP, **once)}
        if flex := simulators.get("mujoco_flex"):
            runs["mujoco-discrete"] = flex.motion(body, "discrete", STEP, **once)
            runs["mujoco-stiff-contact"] = flex.motion(body, "discrete", STEP, (2 * STEP, 1.0), **once)
        if vbd := simulators.get("newton_vbd"):
            runs["newton-10"] = vbd.motion(body, STEP, 10, **once)
            runs["newton-50-stiff-contact"] = vbd.motion(body, STEP, 50, 1e5, **once)
        for key, run in runs.items():
            rows += _rows(f"blocks-{name}/{key}", body, run, missing, resting=name == "rest")
    ours = {row.quantity: row.value for row in rows if row.case == "rivals/blocks-hit/dln_jax"}
    rows.append(expect("rivals/blocks", "crossings", "this library: none", ours["crossings"], 0.0))
    return Findings(rows)


def resting(seconds: float) -> Body:
    """The upper block is let go 6 mm above the lower one."""
    return _blocks(np.linspace(0.75, 1.0, 26) * seconds, 0.0)


def hitting() -> Body:
    """The upper block is thrown at the lower one at 3 m/s; 0.1 s."""
    return _blocks(STEP * np.arange(1, 51), 3.0)


def depth(mesh: Mesh, x: np.ndarray) -> tuple[float, float]:
    """The largest depth of a vertex of one component in another, m, and the smallest distance of one outside, m."""
    number_of, skin = components(mesh), boundary(mesh)
    deepest, nearest = 0.0, np.inf
    for part in range(number_of.max() + 1):
        mine = np.unique(mesh.elements[number_of == part])
        others, facets = mesh.elements[number_of != part], skin[~np.isin(skin[:, 0], mine)]
        points = np.intersect1d(mine, skin)
        of_points = np.repeat(x[points][:, None, None], len(facets), axis=1)
        of_facets = np.repeat(x[facets][None], len(points), axis=0)
        squares = _squares(jnp.asarray(np.concatenate([of_points, of_facets], axis=2)))
        distances = np.sqrt(np.asarray(squares)).min(axis=1)
        edges = np.swapaxes(x[others[:, 1:]] - x[others[:, :1]], 1, 2)
        place = np.einsum("mij,pmj->pmi", np.linalg.inv(edges), x[points][:, None] - x[others[:, 0]])
        inside = ((place > 0).all(axis=2) & (place.sum(axis=2) < 1)).any(axis=1)
        deepest = max(deepest, distances[inside].max(initial=0.0))
        nearest = min(nearest, distances[~inside].min(initial=np.inf))
    return float(deepest), float(nearest)


_squares = jax.jit(jax.vmap(jax.vmap(lambda pair: squared_distance(pair, jnp.asarray(POINT_TRIANGLE)))))
"""Positions [points, facets, 4, 3] -> squared distances, m²."""


def force_on_lower(body: Body, x: np.ndarray) -> float:
    """Force of the upper block on the lower one if that is at rest, N: what holds it, less its weight."""
    masses = lumped_masses(body.mesh, DENSITY)
    lower = np.unique(body.mesh.elements[components(body.mesh) == components(body.mesh)[0]])
    holding = GRAVITY * masses[body.held].sum() - elastic_forces(body)(x)[body.held, 2].sum()
    return float(holding - GRAVITY * masses[lower].sum())


def _blocks(times: np.ndarray, speed: float) -> Body:
    lower, upper = box((0.4, 0.4, 0.2), (4, 4, 2)), box((0.2, 0.2, 0.2), (3, 3, 3))
    angle = np.deg2rad(30)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    above = (upper.vertices - [0.1, 0.1, 0.0]) @ turn.T + [0.2, 0.2, 0.206]
    mesh = make_mesh(
        np.concatenate([lower.vertices, above]),
        np.concatenate([lower.elements, upper.elements + len(lower.vertices)]),
    )
    v = np.where(np.arange(len(mesh.vertices))[:, None] >= len(lower.vertices), [0.0, 0.0, -speed], 0.0)
    held = vertices_where(mesh, lambda x: x[:, 2] == 0)
    return Body(mesh, held, 1e5, 0.3, np.round(times / STEP) * STEP, near=NEAR, v=v)


def _rows(case: str, body: Body, run: Run, missing: str, *, resting: bool) -> list[Row]:
    text = f"{len(body.mesh.elements)} tetrahedra, steps of 2 ms; {missing}".rstrip("; ")
    deepest, nearest = np.transpose([depth(body.mesh, x) for x in run.x])
    crossed = sum(bool(crossings(body.mesh, x)) for x in run.x) if np.isfinite(run.x).all() else np.inf
    rows = [
        number(case, "crossings", f"moments with surfaces that cross, of {len(run.x)}", crossed),
        number(case, "deepest", "vertex of one block in the other", deepest.max(), "m"),
        number(case, "nearest", "vertex of one block to the surface of the other", nearest.min(), "m"),
        number(case, "processor_seconds_per_step", text, run.seconds * STEP, "s"),
    ]
    if resting:
        upper = components(body.mesh) != components(body.mesh)[0]
        weight = GRAVITY * lumped_masses(body.mesh, DENSITY)[np.unique(body.mesh.elements[upper])].sum()
        forces = np.array([force_on_lower(body, x) for x in run.x])
        text = f"mean over the last quarter, relative to the weight of {weight:.1f} N"
        rows.append(number(case, "force_error", text, abs(forces.mean() / weight - 1)))
        rows.append(number(case, "force_spread", "standard deviation over the weight", forces.std() / weight))
    return rows
