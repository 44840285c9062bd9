"""The swinging cantilever against a fine mesh, and derivatives of its motion by Young's modulus.

`swing` compares simulators on one mesh, so that its errors are those of time steps and solvers. Here the error is that
against quadratic elements in short steps, and contains that of the mesh. Displacements of the vertices that all these
meshes have in common are compared.
"""

import numpy as np

from dln_jax.softbody.mesh import quadratic
from dln_jax.softbody.mesh.mesh import vertices_where
from dln_jax.softbody.mesh.shapes import box
from scripts.reports.case import Findings
from scripts.reports.rows import Row
from scripts.reports.soft_bodies.rivals import own
from scripts.reports.soft_bodies.rivals.body import KIRCHHOFF, NEO_HOOKEAN, SMITH, Body, Run, reference_motion
from scripts.reports.soft_bodies.rivals.simulators import number, rivals

LENGTHS = (1.0, 0.25, 0.25)
CHANGE = 1e-4
"""Relative change of Young's modulus in central differences."""


def cantilever(cells: int, *, quick: bool = False, order: int = 1, law: str = NEO_HOOKEAN) -> Body:
    """A cantilever with this number of cells through its thickness, E = 1e6 Pa, nu = 0.3."""
    mesh = box(LENGTHS, (4 * cells, cells, cells))
    mesh = quadratic(mesh) if order == 2 else mesh
    held = vertices_where(mesh, lambda x: x[:, 0] == 0)
    return Body(mesh, held, 1e6, 0.3, 0.1 * np.arange(1, 3 if quick else 6), law=law)


def mesh(quick: bool) -> Findings:
    """Linear elements of all simulators and quadratic ones of this library, against a fine mesh."""
    simulators, missing = rivals()
    rows: list[Row] = []
    for law in (NEO_HOOKEAN, KIRCHHOFF):
        exact = _common(body := cantilever(3, quick=quick, order=2, law=law), own.motion(body, "midpoint", 0.005).x)
        runs: dict[str, tuple[Body, Run]] = {}
        for cells in (3, 6):
            body = cantilever(cells, quick=quick, law=law)
            if law == NEO_HOOKEAN:
                runs[f"dln_jax/linear/{cells}"] = body, own.motion(body, "midpoint", 0.01)
                if flex := simulators.get("mujoco_flex"):
                    runs[f"mujoco-discrete/linear/{cells}"] = body, flex.motion(body, "discrete", 0.002)
                if (vbd := simulators.get("newton_vbd")) and cells == 3:
                    runs[f"newton-10/linear/{cells}"] = body, vbd.motion(body, 0.002, 10)
            elif flex := simulators.get("mujoco_flex"):
                runs[f"mujoco-euler/linear/{cells}"] = body, flex.motion(body, "Euler", 0.003 / cells)
        if law == NEO_HOOKEAN:
            for cells in (1, 2):
                body = cantilever(cells, quick=quick, order=2)
                runs[f"dln_jax/quadratic/{cells}"] = body, own.motion(body, "midpoint", 0.01)
        for key, (body, run) in runs.items():
            error = float(np.linalg.norm(_common(body, run.x) - exact) / np.linalg.norm(exact))
            text = f"{len(body.mesh.elements)} tetrahedra, {law}; {missing}".rstrip("; ")
            rows.append(number(f"mesh/{key}", "error", text, error if np.isfinite(error) else np.inf))
            rows.append(number(f"mesh/{key}", "processor_seconds_per_second", text, run.seconds, "s"))
    return Findings(rows)


def gradient(quick: bool) -> Findings:
    """Derivative of the mean height at the end by Young's modulus, in reverse mode, and its error."""
    simulators, missing = rivals()
    rows: list[Row] = []
    for law in (NEO_HOOKEAN, SMITH):
        body = cantilever(3, quick=quick, law=law)
        up, down = (_height(body, factor) for factor in (1 + CHANGE, 1 - CHANGE))
        exact = (up - down) / (2 * CHANGE * body.modulus)
        suffix = "" if law == NEO_HOOKEAN else "-smith"
        steps = (("midpoint", 0.01), ("midpoint", 0.002), ("backward-euler", 0.01))[: 1 if suffix else 3]
        results = {f"{rule}{suffix}/{dt}": own.motion_gradient(body, rule, dt) for rule, dt in steps}
        if suffix and (explicit := simulators.get("newton_explicit")):
            results |= {f"newton-explicit/{dt}": explicit.motion_gradient(body, dt) for dt in (1e-3, 5e-4)}
        for key, (run, value, differences) in results.items():
            case, text = f"gradient/{key}", f"of {exact:.4e} m/Pa by differences of the reference, {law}; {missing}"
            rows.append(number(case, "error", text.rstrip("; "), abs(value / exact - 1)))
            text = "against differences of the same program"
            rows.append(number(case, "error_of_differences", text, abs(value / differences - 1)))
            rows.append(number(case, "processor_seconds_per_second", law, run.seconds, "s"))
    return Findings(rows)


def _height(body: Body, factor: float) -> float:
    changed = body._replace(modulus=factor * body.modulus, times=body.times[-1:])
    return float(reference_motion(changed, 2e-4)[-1, :, 2].mean())


def _common(body: Body, x: np.ndarray) -> np.ndarray:
    """Displacements [s, 16, 3] of the vertices that all meshes have in common."""
    places = box(LENGTHS, (4, 1, 1)).vertices
    places = places[places[:, 0] > 0]
    distances = np.linalg.norm(body.mesh.vertices - places[:, None], axis=2)
    nearest = distances.argmin(axis=1)
    assert distances.min(axis=1).max() < 1e-9
    return x[:, nearest] - body.mesh.vertices[nearest]
