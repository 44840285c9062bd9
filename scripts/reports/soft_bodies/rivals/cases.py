"""Speed against error of this library and of the simulators that can be imported, on one processor.

A cantilever of 540 linear tetrahedra swings under its weight for 0.5 s, and a block of 320 falls on a rigid floor
without friction and rebounds. All have the same mesh, lumped masses, load and material. Errors are those of the
displacement against `reference_motion`, which shares the mesh: what remains are time steps, solvers and
contact. Processor time leaves compilation out. Set OPENBLAS_NUM_THREADS=1: waiting threads would count.
"""

import importlib
from types import ModuleType
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dln_jax.figures import style
from dln_jax.softbody.mesh.mesh import vertices_where
from dln_jax.softbody.mesh.shapes import box
from scripts.reports.case import Findings
from scripts.reports.rows import Row, expect
from scripts.reports.soft_bodies.rivals import own
from scripts.reports.soft_bodies.rivals.body import KIRCHHOFF, Body, Run, reference_motion, relative_error

NEEDED = {"mujoco_flex": "mujoco", "newton_vbd": "newton", "torch_fem": "torch-fem"}
"""Modules of this package, and what they need."""
STEPS = (0.02, 0.01, 0.005, 0.002)
LABELS = {
    "backward-euler": "dln_jax, backward Euler",
    "midpoint": "dln_jax, midpoint",
    "mujoco-discrete": "MuJoCo, discrete",
    "mujoco-kirchhoff-euler": "MuJoCo, explicit Euler (StVK)",
    "newton-10": "Newton VBD, 10 sweeps",
    "newton-50": "Newton VBD, 50 sweeps",
}


def rivals() -> tuple[dict[str, ModuleType], str]:
    """The rivals that can be imported, and a sentence about those that cannot."""
    simulators, missing = {}, []
    for name, package in NEEDED.items():
        try:
            simulators[name] = importlib.import_module(f"scripts.reports.soft_bodies.rivals.{name}")
        except ImportError:
            missing.append(package)
    return simulators, f"not installed: {', '.join(missing)} (pip install 'dln-jax[rivals]')" if missing else ""


def swing(quick: bool) -> Findings:
    """A cantilever of 1 m x 0.25 m x 0.25 m, E = 1e6 Pa, nu = 0.3, released from rest; its tip falls by 0.38 m."""
    mesh = box((1.0, 0.25, 0.25), (12, 3, 3))
    held = vertices_where(mesh, lambda x: x[:, 0] == 0)
    body = Body(mesh, held, 1e6, 0.3, 0.1 * np.arange(1, 3 if quick else 6))
    reference, (simulators, missing) = reference_motion(body, 2e-4), rivals()
    runs = {f"{rule}/{dt}": own.motion(body, rule, dt) for rule in ("backward-euler", "midpoint") for dt in STEPS}
    if flex := simulators.get("mujoco_flex"):
        runs |= {f"mujoco-discrete/{dt}": flex.motion(body, "discrete", dt) for dt in (0.01, 0.005, 0.002, 0.001, 1e-4)}
    if vbd := simulators.get("newton_vbd"):
        runs |= {f"newton-{n}/{dt}": vbd.motion(body, dt, n) for n in (10, 50) for dt in (0.01, 0.002, 0.0005)}
    findings = _findings("swing", body, runs, reference, missing)
    if flex:
        other = body._replace(law=KIRCHHOFF)
        runs = {f"mujoco-kirchhoff-euler/{dt}": flex.motion(other, "Euler", dt) for dt in (0.001, 5e-4, 1e-4)}
        more = _findings("swing", other, runs, reference_motion(other, 2e-4), "")
        findings = Findings(findings.rows + more.rows, {**findings.curves, **more.curves})
    slope, _ = own.motion_gradient(body, "midpoint", 0.01)
    text = "by Young's modulus, reverse mode; the rivals have none for motions, except by differences"
    row = _number("swing/midpoint/0.01", "gradient_processor_seconds_per_second", text, slope.seconds, "s")
    return Findings([*findings.rows, row], findings.curves)


def drop(quick: bool) -> Findings:
    """A cube of 0.5 m, E = 1e5 Pa, nu = 0.3, falls by 0.1 m and rebounds; 0.5 s."""
    mesh = box((0.5, 0.5, 0.5), (4, 4, 4))
    mesh = mesh._replace(vertices=mesh.vertices + np.array([0.0, 0.0, 0.1]))
    body = Body(mesh, np.zeros(0, int), 1e5, 0.3, 0.1 * np.arange(1, 3 if quick else 6), floor=True)
    reference, (simulators, missing) = reference_motion(body, 1e-4, 1e6), rivals()
    runs = {f"{rule}/{dt}": own.motion(body, rule, dt) for rule in ("backward-euler", "midpoint") for dt in STEPS}
    if flex := simulators.get("mujoco_flex"):
        runs |= {f"mujoco-discrete/{dt}": flex.motion(body, "discrete", dt) for dt in (0.01, 0.002, 5e-4)}
        stiff = {dt: flex.motion(body, "discrete", dt, (max(2 * dt, 2e-3), 1.0)) for dt in (0.002, 5e-4)}
        runs |= {f"mujoco-stiff-contact/{dt}": run for dt, run in stiff.items()}
    if vbd := simulators.get("newton_vbd"):
        runs |= {f"newton-10/{dt}": vbd.motion(body, dt, 10) for dt in (0.002, 5e-4)}
        runs |= {f"newton-50-stiff-contact/{dt}": vbd.motion(body, dt, 50, 1e6) for dt in (0.002, 5e-4)}
    return _findings("drop", body, runs, reference, missing)


def hanging(quick: bool) -> Findings:
    """Equilibrium of the cantilever, E = 3e6 Pa, and its derivative by Young's modulus."""
    del quick
    mesh = box((1.0, 0.25, 0.25), (12, 3, 3))
    body = Body(mesh, vertices_where(mesh, lambda x: x[:, 0] == 0), 3e6, 0.3, np.ones(1))
    (simulators, missing), ours = rivals(), own.static(body)
    slope, value = own.static_gradient(body)
    rows = [
        _seconds("hanging/dln_jax", "solve", ours, missing),
        _seconds("hanging/dln_jax", "gradient", slope, f"{value:.6e} m/Pa"),
    ]
    if fem := simulators.get("torch_fem"):
        theirs, (their_slope, their_value) = fem.static(body), fem.static_gradient(body)
        difference = relative_error(body, theirs.x, ours.x)
        rows += [
            _seconds("hanging/torch-fem", "solve", theirs, fem.VERSION),
            _seconds("hanging/torch-fem", "gradient", their_slope, f"{their_value:.6e} m/Pa"),
            expect("rivals/hanging", "difference", "displacements of dln_jax and torch-fem", difference, 1e-5),
            expect("rivals/hanging", "gradient_difference", "the same", abs(their_value / value - 1), 1e-5),
        ]
    return Findings(rows)


def figure(curves: dict[str, Any]) -> Figure:
    """Error against processor time per simulated second, each curve labelled at its end."""
    picture, [[axis]] = style.figure(1, 1, height=4.2)
    for key, colour in style.colours_of(LABELS).items():
        if key in curves:
            seconds, errors = np.reshape(curves[key], (-1, 2)).T
            axis.loglog(seconds, errors, "o-", color=colour, markersize=4, label=LABELS[key])
    axis.set(xlabel="processor time per simulated second, s", ylabel="relative error of the displacement")
    style.legend(picture, *axis.get_legend_handles_labels(), loc="outside right upper")
    return picture


def _findings(name: str, body: Body, runs: dict[str, Run], reference: np.ndarray, missing: str) -> Findings:
    rows: list[Row] = []
    curves: dict[str, Any] = {}
    for key, run in runs.items():
        error = relative_error(body, run.x, reference)
        case, text = f"{name}/{key}", f"{len(body.mesh.elements)} tetrahedra, {body.law}; {missing}".rstrip("; ")
        rows.append(_number(case, "error", text, error))
        rows.append(_number(case, "processor_seconds_per_second", text, run.seconds, "s"))
        rows.append(_number(case, "compile_seconds", text, run.compiling, "s"))
        curves.setdefault(key.split("/")[0], []).extend([run.seconds, error])
    return Findings(rows, curves)


def _seconds(name: str, quantity: str, run: Run, text: str) -> Row:
    return _number(f"{name}", f"{quantity}_processor_seconds", text, run.seconds, "s")


def _number(case: str, quantity: str, text: str, value: float, unit: str = "1") -> Row:
    """A row without a bound: rivals are measured, not judged."""
    return Row(f"rivals/{case}", quantity, float(value), unit, None, None, False, text)
