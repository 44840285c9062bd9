"""Simulate a soft body with implicit time steps.

Scenes: a cantilever, a twisted bar, a sliding block, a falling body and a crawler. Prints the speed and how accurately
the steps were solved. The run folder gets motion.gif (motion.mp4 too with ffmpeg), energy.png (energies against time,
which show what the implicit step damps), moments.png, metrics.json, report.json and config.json. The density is 1000
kg/m³; bodies in the plane are 1 m thick.

For your own mesh, add --mesh FILE to the scenes beam and drop; its last axis points up. Formats: .msh of Gmsh (2.2 and
4.1) and, with the extra [mesh], .vtk, .vtu, .obj and TetGen's .ele. Tetrahedra form a body in space, triangles with
constant z a body in the plane. Physical groups become named sets, for --pin. The command prints what it left out or
repaired. An .npz has `vertices` [n, 2 or 3] in m, `elements` [m, 3 or 4] (triangles or tetrahedra, indices from 0) and,
for the beam, optionally `held` [k] (vertices; by default those with the smallest x).
"""

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dln_jax.options import Drawn, Folder, Unstated

GALLERY = (0, 3, 2, 1, 4)
"""Order of the scenes in the combined picture."""


@dataclass(frozen=True)
class Arguments(Folder, Drawn):
    """What to simulate, how, and where the results go. Unset options take the scene's defaults."""

    scene: Literal["beam", "twist", "slope", "drop", "creature", "all"] = "beam"
    """The scene to simulate; all: every scene in its own subfolder, and one figure of all."""
    integrator: Literal["backward-euler", "bdf2", "midpoint", "average-vector-field"] = "backward-euler"
    """backward-euler damps, bdf2 (second order) damps little, midpoint (second order) does not damp,
    average-vector-field (second order) keeps the energy."""
    dt: Unstated[float] = None
    """Time step, s (default: the scene's)."""
    seconds: Unstated[float] = None
    """Duration of the motion, s (default: the scene's)."""
    cells: Unstated[int] = None
    """Cells across the body (drop: rings of the disc); not for the creature."""
    dimension: Unstated[int] = None
    """beam, drop: 2 or 3."""
    youngs_modulus: Unstated[float] = None
    """Young's modulus, Pa; not for the creature."""
    poisson_ratio: Unstated[float] = None
    """Poisson's ratio, between -1 and 0.5; not for the creature."""
    material: Unstated[Literal["stable-neo-hookean", "neo-hookean", "st-venant-kirchhoff", "corotated"]] = None
    """Strain energy; not for the creature (default: stable-neo-hookean)."""
    order: Unstated[int] = None
    """1: linear elements (default); 2: quadratic elements, which do not lock in bending. Not for the creature."""
    mixed: bool = False
    """Quadratic elements with one pressure each, for nearly incompressible bodies (nu near 0.5); needs --order 2."""
    mesh: Unstated[Path] = None
    """beam, drop: your own mesh, as described above."""
    scale: Unstated[float] = None
    """--mesh: length of the file's unit in m, such as 0.001 for millimetres (default: 1)."""
    pin: Unstated[str] = None
    """beam with --mesh: named sets that are held, separated by commas."""
    youngs_modulus_of: Unstated[str] = None
    """--mesh: E in Pa of named sets of elements, as tip=1e6,core=5e6."""
    pressure: Unstated[str] = None
    """--mesh: gauge pressure in Pa in chambers, as inner=2e4 for all closed cavities or wall=2e4,bag=1e3 for chambers
    whose facets are in named sets; flat caps close their openings."""
    load: Unstated[str] = None
    """--mesh: total force in N on named sets, as tip=0,-5 or tip=0,-5;side=2,0: two components in the plane, three in
    space, spread over the area of the set, or over its vertices if it covers no part of the surface."""
    contact: bool = False
    """beam, twist, drop: keep bodies apart, and each from itself, with friction 0.3; backward-euler or bdf2."""
    vtu: bool = False
    """Also write motion.pvd and its .vtu files, for ParaView (extra [mesh])."""
    precision: Literal["f32", "f64"] = "f64"
    """Floating-point type."""


def main(options: Arguments) -> None:
    """Simulates one scene into the run folder, or all scenes into subfolders with a combined picture."""
    import jax.numpy as jnp

    from dln_jax.commands.simulations.motion import LABELS, figures_of, moments_of, results, run_motion, warnings
    from dln_jax.commands.simulations.scenes import announce, prepare
    from dln_jax.figures.soft_bodies import moments_figure
    from dln_jax.files import write_figure
    from dln_jax.metrics.report import conditions, write_report
    from dln_jax.precision import data_type
    from dln_jax.runs.folder import command_folder
    from dln_jax.runs.report import Report, finish, rows_of
    from dln_jax.softbody.examples import EXAMPLES
    from dln_jax.softbody.mesh.files import write_motion

    several, precision = options.scene == "all", data_type(options.precision)
    scenes = [prepare(options, name) for name in (EXAMPLES if several else [options.scene])]
    with command_folder(options, "simulate") as folder:
        pictures = []
        for prepared in scenes:
            name, example, dt = prepared.name, prepared.example, prepared.dt
            own, mesh = folder / name if several else folder, example.scene.mesh
            own.mkdir(exist_ok=True)
            announce(prepared, options)
            motion = run_motion(prepared, precision)
            rows = results(name, mesh, motion)
            numbers = {row.quantity: row.value for row in rows}
            dtype = jnp.dtype(precision).name
            facts = conditions(dtype=dtype, seeds=[0], integrator=options.integrator, dt=dt)
            write_report(own / "report.json", rows, facts)
            if options.vtu:
                shown = slice(motion.finite)
                moving = mesh, motion.t[shown], motion.x[shown], motion.v[shown]
                write_motion(own / "motion.pvd", *moving, stride=motion.stride)
            pictures.append(moments_of(name, example, motion))
            title = f"{name}: {options.integrator}, dt = {dt:.4g} s"
            report = Report(
                metrics={name: value for name, value in numbers.items() if math.isfinite(value)},
                rows=rows_of(numbers, LABELS, {row.quantity: row.unit for row in rows}),
                title="",
                lines=tuple(warnings(motion)),
                figures=figures_of(name, example, motion, pictures[-1], title),
                chosen={"dt": dt, "seconds": prepared.steps * dt},
            )
            finish(own, dataclasses.replace(options, scene=name), report)
        if several and options.figures:
            gallery = moments_figure([pictures[i] for i in GALLERY], columns=3)
            write_figure(folder / "soft-bodies.png", gallery)
