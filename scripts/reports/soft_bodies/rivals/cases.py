"""Speed against error of this library and of the simulators that can be imported, on one processor.

A cantilever of 540 linear tetrahedra swings under its weight for 0.5 s, and a block of 320 falls on a rigid floor
without friction and rebounds. All have the same mesh, lumped masses, load and material. Errors are those of the
displacement against `reference_motion`, which shares the mesh: what remains are time steps, solvers and
contact. Processor time leaves compilation out. Set OPENBLAS_NUM_THREADS=1: waiting threads would count.
"""

import numpy as np

from dln_jax.softbody.mesh.shapes import box
from scripts.reports.case import Findings
from scripts.reports.rows import Row, expect
from scripts.reports.soft_bodies.rivals import own
from scripts.reports.soft_bodies.rivals.body import KIRCHHOFF, SMITH, Body, Run, reference_motion, relative_error
from scripts.reports.soft_bodies.rivals.finer import cantilever
from scripts.reports.soft_bodies.rivals.simulators import findings, number, rivals

STEPS = (0.02, 0.01, 0.005, 0.002)


def swing(quick: bool) -> Findings:
    """A cantilever of 1 m x 0.25 m x 0.25 m, E = 1e6 Pa, nu = 0.3, released from rest; its tip falls by 0.38 m."""
    body = cantilever(3, quick=quick)
    reference, (simulators, missing) = reference_motion(body, 2e-4), rivals()
    runs = {f"{rule}/{dt}": own.motion(body, rule, dt) for rule in ("backward-euler", "midpoint") for dt in STEPS}
    if flex := simulators.get("mujoco_flex"):
        runs |= {f"mujoco-discrete/{dt}": flex.motion(body, "discrete", dt) for dt in (0.01, 0.005, 0.002, 5e-4, 1e-4)}
    if vbd := simulators.get("newton_vbd"):
        tried = ((10, 0.01), (10, 0.002), (10, 5e-4), (50, 0.01), (50, 0.002))
        runs |= {f"newton-{sweeps}/{dt}": vbd.motion(body, dt, sweeps) for sweeps, dt in tried}
    rows = findings("swing", body, runs, reference, missing)
    # Explicit methods of rivals run other laws only, and are compared with references of these.
    for module, law, name, steps, run in (
        ("mujoco_flex", KIRCHHOFF, "mujoco-euler", (1e-3, 5e-4, 1e-4), lambda by, at, dt: by.motion(at, "Euler", dt)),
        ("newton_explicit", SMITH, "newton-explicit", (1e-3, 5e-4), lambda by, at, dt: by.motion(at, dt)),
    ):
        if module in simulators:
            other = body._replace(law=law)
            runs = {f"{name}/{dt}": run(simulators[module], other, dt) for dt in steps}
            rows += findings("swing", other, runs, reference_motion(other, 2e-4), "")
    return Findings(rows)


def drop(quick: bool) -> Findings:
    """A cube of 0.5 m, E = 1e5 Pa, nu = 0.3, falls by 0.1 m and rebounds; 0.5 s.

    The reference's floor is a penalty of 1e7 N/m for each vertex. Another of 1e6 N/m says how much of an error is
    only a matter of how a contact is modelled.
    """
    mesh = box((0.5, 0.5, 0.5), (4, 4, 4))
    mesh = mesh._replace(vertices=mesh.vertices + np.array([0.0, 0.0, 0.1]))
    body = Body(mesh, np.zeros(0, int), 1e5, 0.3, 0.1 * np.arange(1, 3 if quick else 6), floor=True)
    reference, (simulators, missing) = reference_motion(body, 1e-4, 1e7), rivals()
    softer = relative_error(body, reference_motion(body, 2e-4, 1e6), reference)
    tried = (("backward-euler", (0.01, 0.002)), ("bdf2", (0.01, 0.005, 0.002)))
    runs = {f"{rule}/{dt}": own.motion(body, rule, dt) for rule, steps in tried for dt in steps}
    if flex := simulators.get("mujoco_flex"):
        runs |= {f"mujoco-discrete/{dt}": flex.motion(body, "discrete", dt) for dt in (0.01, 0.002, 5e-4)}
        stiff = {dt: flex.motion(body, "discrete", dt, (2 * dt, 1.0)) for dt in (0.002, 5e-4)}
        runs |= {f"mujoco-stiff-contact/{dt}": run for dt, run in stiff.items()}
    if vbd := simulators.get("newton_vbd"):
        runs |= {f"newton-10/{dt}": vbd.motion(body, dt, 10) for dt in (0.002, 5e-4)}
        runs["newton-10-stiff-contact/0.002"] = vbd.motion(body, 0.002, 10, 1e6)
    rows = findings("drop", body, runs, reference, missing)
    text = "the reference with a floor of 1e6 N/m for each vertex instead of 1e7"
    return Findings([*rows, number("drop/reference", "by_floor", text, softer)])


def hanging(quick: bool) -> Findings:
    """Equilibrium of the cantilever, E = 3e6 Pa, and its derivative by Young's modulus."""
    del quick
    body = cantilever(3)._replace(modulus=3e6, times=np.ones(1))
    (simulators, missing), ours = rivals(), own.static(body)
    slope, value = own.static_gradient(body)
    rows = [
        _seconds("dln_jax", "solve", ours, missing),
        _seconds("dln_jax", "gradient", slope, f"{value:.6e} m/Pa"),
    ]
    for name, module in (("torch-fem", "torch_fem"), ("tatva", "tatva_fem")):
        if fem := simulators.get(module):
            theirs, (their_slope, their_value) = fem.static(body), fem.static_gradient(body)
            difference, text = relative_error(body, theirs.x, ours.x), f"dln_jax and {name}"
            rows += [
                _seconds(name, "solve", theirs, fem.VERSION),
                _seconds(name, "gradient", their_slope, f"{their_value:.6e} m/Pa"),
                expect(f"rivals/hanging/{name}", "difference", f"displacements of {text}", difference, 1e-5),
                expect(f"rivals/hanging/{name}", "gradient_difference", text, abs(their_value / value - 1), 1e-5),
            ]
    return Findings(rows)


def _seconds(name: str, quantity: str, run: Run, text: str) -> Row:
    return number(f"hanging/{name}", f"{quantity}_processor_seconds", text, run.seconds, "s")
