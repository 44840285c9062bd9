"""Simulates soft bodies by implicit time steps into a run folder."""

import dataclasses
import functools
import inspect
import math
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.figures.soft_bodies import Moments, moments_figure
from dln_jax.files import write_figure, write_json
from dln_jax.metrics.report import conditions, write_report
from dln_jax.precision import data_type
from dln_jax.rollout import rollout
from dln_jax.runs.arguments import resolved
from dln_jax.runs.progress import progress
from dln_jax.runs.report import print_numbers
from dln_jax.runs.stored_arguments import stored_arguments
from dln_jax.sizes import require_memory, require_within
from dln_jax.softbody.driven import Example, drive, driven_step
from dln_jax.softbody.examples import EXAMPLES
from dln_jax.softbody.integrators import INTEGRATORS
from dln_jax.softbody.mesh.files import require_meshio, write_motion
from dln_jax.softbody.mesh.mesh import components, overlaps
from dln_jax.softbody.scene import Params, State
from dln_jax.softbody.step import Stepper
from dln_jax.softbody.terms.strain_energies import corotated, neo_hookean, st_venant_kirchhoff, stable_neo_hookean
from dln_jax.softbody.verdict import Info
from dln_jax.training.simulation_meshes import listed, own_mesh
from dln_jax.training.simulation_results import SimulatedMotion, draw, finite_moments, line, results, stride, warn
from dln_jax.types import InputError, require_positive
from dln_jax.zoo.run_folder import CONFIG, run_folder

MATERIALS = {
    energy.__name__.replace("_", "-"): energy
    for energy in (stable_neo_hookean, neo_hookean, st_venant_kirchhoff, corotated)
}
FACETS = {2: "edges", 3: "triangles"}
CHUNKS = 20
"""Number of chunks a motion is split into; progress is shown after every chunk."""
LARGEST_SIZE = 10.0
"""Longer meshes, m, are probably in millimetres."""
ALL = "all"
GALLERY = (0, 3, 2, 1, 4)
"""Order of the scenes in the combined picture."""


class PreparedScene(NamedTuple):
    """A scene with its stepper, ready to simulate."""

    options: Any
    example: Example
    stepper: Stepper
    dt: float
    """Time step, s."""
    steps: int
    statements: tuple[str, ...]
    """Notes on what the reader of the mesh left out or repaired."""


def simulate_all(options: Any) -> None:
    """Simulates one scene into the run folder, or all scenes into subfolders with a combined picture."""
    several = options.scene == ALL
    prepared = [
        prepare(dataclasses.replace(options, scene=name)) for name in (EXAMPLES if several else [options.scene])
    ]
    with run_folder(options.out, "simulate") as folder:
        pictures = []
        for scene in prepared:
            own = folder / scene.options.scene if several else folder
            own.mkdir(exist_ok=True)
            pictures.append(simulate(scene, own))
        if several and options.figures:
            gallery = moments_figure([pictures[i] for i in GALLERY], columns=3)
            write_figure(folder / "soft-bodies.png", gallery)
        print(f"run folder: {folder}")


def prepare(options: Any) -> PreparedScene:
    """Builds the scene and its stepper; checks the whole command line before anything is written."""
    example, statements = example_of(options)
    if options.vtu:
        require_meshio("--vtu")
    dt, seconds = resolved(options, {"dt": example.dt, "seconds": example.seconds}).values()
    require_positive(dt=dt, seconds=seconds)
    if not dt <= seconds < math.inf:
        raise InputError(f"--seconds is {seconds} and --dt {dt}; expected a finite duration of at least one time step")
    steps = round(seconds / dt)
    require_within({"steps (--seconds / --dt)": steps})
    # Positions and velocities of every step in float64, held twice while chunks are concatenated.
    require_memory(f"a motion of {steps:,} steps", 32.0 * steps * example.scene.mesh.vertices.size)
    if options.halvings < 0:
        raise InputError(f"--halvings is {options.halvings}; expected 0 or a positive integer")
    stepper = driven_step(example, dt, INTEGRATORS[options.integrator], halvings=options.halvings)
    return PreparedScene(options, example, stepper, dt, steps, statements)


def simulate(prepared: PreparedScene, folder: Path) -> Moments:
    """Simulates one scene, writes its folder and returns its picture."""
    options, example, _, dt, steps, statements = prepared
    write_json(folder / CONFIG, {**stored_arguments(options), "dt": dt, "seconds": steps * dt})
    mesh = example.scene.mesh
    pieces, size = int(components(mesh).max()) + 1, np.ptp(mesh.vertices, axis=0)
    kind = "" if mesh.midsides is None else "mixed quadratic " if options.mixed else "quadratic "
    print(
        f"{options.scene}: {len(mesh.vertices)} vertices, {len(mesh.elements)} {kind}elements in {pieces} "
        f"component{'s' * (pieces > 1)}, {' x '.join(f'{length:.4g}' for length in size)} m, "
        f"{int(example.scene.free.sum())} unknowns; {options.integrator}, dt {dt:.4g} s, {options.precision}"
    )
    for statement in statements:
        print(statement)
    if mesh.sets:
        print(f"named sets: {listed(mesh)}")
    if pieces > 1 and not options.contact:
        loose = "no two elements share a vertex" if pieces == len(mesh.elements) else f"{pieces} parts share no vertex"
        print(
            f"warning: {loose}: they move apart, or through one another; add --contact to keep them apart, or, if the "
            "body is one, merge vertices at the same position before you save the mesh"
        )
    if size.max() > LARGEST_SIZE:
        print(
            f"warning: the body is {size.max():.4g} m long; expected lengths in metres: if the mesh is in millimetres, "
            "add --scale 0.001"
        )
    if mesh.turned:
        print(f"{mesh.turned} of {len(mesh.elements)} elements were inverted and have been turned")
    if count := len(overlaps(mesh)):
        print(f"elements overlap at {count} of their {FACETS[mesh.dimension]}: there, mass and stiffness add up")
    motion = run_motion(prepared)
    rows = results(options.scene, mesh, motion)
    write_json(folder / "metrics.json", {row.quantity: row.value for row in rows if math.isfinite(row.value)})
    dtype = jnp.dtype(data_type(options.precision)).name
    facts = conditions(dtype=dtype, seeds=[options.seed], integrator=options.integrator, dt=dt)
    write_report(folder / "report.json", rows, facts)
    print_numbers(map(line, rows))
    warn(motion)
    if options.vtu:
        shown = slice(finite_moments(motion))
        write_motion(
            folder / "motion.pvd", mesh, motion.t[shown], motion.x[shown], motion.v[shown], stride=stride(motion)
        )
    title = f"{options.scene}: {options.integrator}, dt = {dt:.4g} s"
    return draw(options.scene, example, motion, folder, title=title, figures=options.figures)


def example_of(options: Any) -> tuple[Example, tuple[str, ...]]:
    """Builds the scene with the options set on the command line; also returns statements about the mesh of a file.

    Raises:
        InputError: an option that the scene does not have, options that exclude each other, or an invalid value.
    """
    scene = EXAMPLES[options.scene]
    names = ("cells", "dimension", "youngs_modulus", "poisson_ratio", "friction", "turns", "order", "mesh")
    choices: dict[str, Any] = {name: getattr(options, name) for name in names}
    choices["strain_energy"] = None if options.material is None else MATERIALS[options.material]
    choices["mixed"] = options.mixed or None
    choices["contact"] = options.contact or None
    if options.mixed and options.order != 2:
        raise InputError("--mixed needs --order 2: mixed elements are quadratic")
    choices = {name: value for name, value in choices.items() if value is not None}
    known = inspect.signature(scene).parameters
    if options.pin is not None and "held" not in known:
        raise InputError(f"the {options.scene} scene has no --pin; leave it out")
    for name in choices:
        if name not in known:
            option = "material" if name == "strain_energy" else name.replace("_", "-")
            raise InputError(f"the {options.scene} scene has no --{option}; leave it out")
    if options.mesh is not None and (beside := [name for name in ("cells", "dimension") if name in choices]):
        raise InputError(f"--{beside[0]} sets the scene's own mesh; leave out either it or --mesh")
    modulus = choices.get("youngs_modulus", getattr(known.get("youngs_modulus"), "default", 0.0))
    from_file, statements = own_mesh(options, modulus)
    choices |= {name: value for name, value in from_file.items() if name in known}
    if "held" in from_file and "held" not in known:
        statements = (*statements, f"the {options.scene} scene holds no vertices: the file's `held` is not used")
    if options.seed < 0:
        raise InputError(f"--seed is {options.seed}; expected 0 or a positive integer")
    if "seed" in known:
        choices["seed"] = options.seed
    example = scene(**choices)
    params = in_precision(example.scene.params, data_type(options.precision))
    return example._replace(scene=example.scene._replace(params=params)), statements


def in_precision(tree: Any, precision: Any) -> Any:
    """Casts the floating-point arrays of a tree to this precision."""
    return jax.tree.map(lambda leaf: leaf.astype(precision) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf, tree)


def run_motion(prepared: PreparedScene) -> SimulatedMotion:
    """Runs the motion in chunks of one compiled program; times compilation separately and waits for the results."""
    options, example, (init, step), dt, steps, _ = prepared
    count = max(1, steps // CHUNKS)
    params = example.scene.params
    start = state = in_precision(init(), data_type(options.precision))

    def observe(state: State, info: Info) -> tuple[Any, Any, Info]:
        return state.x, state.v, info

    def advance(state: State, params: Params, driven: Any) -> tuple[State, Any]:
        return rollout(functools.partial(step, params), state, driven, observe=observe)

    with progress(steps) as show:
        began = time.perf_counter()
        program = jax.jit(advance).lower(state, params, drive(example, dt, count)).compile()
        compiled = time.perf_counter() - began
        seen, spent, done = [], 0.0, 0
        while done < steps:
            driven = drive(example, dt, count, first=done)
            began = time.perf_counter()
            state, chunk = jax.block_until_ready(program(state, params, driven))
            spent += time.perf_counter() - began
            done += count
            seen.append(jax.tree.map(np.asarray, chunk))
            show(min(done, steps), f"t = {min(done, steps) * dt:.2f} s")
    x, v, info = jax.tree.map(lambda *chunks: np.concatenate(chunks)[:steps], *seen)
    x, v = (np.concatenate([np.asarray(first)[None], rest]) for first, rest in ((start.x, x), (start.v, v)))
    return SimulatedMotion(dt * np.arange(steps + 1), x, v, info, compiled, done / spent)
