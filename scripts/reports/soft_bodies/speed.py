"""Speed of steps and gradients, and of the linear solver that a scene's stiffness chooses."""

import functools
import itertools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import Delaunay

from dln_jax.rollout import rollout
from dln_jax.softbody.mesh.mesh import Mesh, make_mesh
from dln_jax.softbody.mesh.shapes import beam
from dln_jax.softbody.mesh.simplices import regularity
from dln_jax.softbody.scene import Params, SoftScene, State, element_energies, make_scene, prepare
from dln_jax.softbody.step import make_step, positions_and_convergence
from dln_jax.softbody.terms.creature import TIME_STEP
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.gravity import gravity
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean
from dln_jax.solvers.elements import linear_solvers, selection
from dln_jax.solvers.elements.assembly import Pattern, pattern
from dln_jax.solvers.elements.energies import ElementEnergy
from dln_jax.solvers.elements.selection import search_takes_at_most
from scripts.reports.case import Findings
from scripts.reports.rows import expect
from scripts.reports.soft_bodies.common import cantilever_of, converges
from scripts.reports.soft_bodies.gradients import crawling, crawling_scene, gait
from scripts.reports.turns import medians_in_turns

LANES = 64
DT = 1 / 30
WAYS = {
    "blocks": linear_solvers.block_tridiagonal,
    "sparse": linear_solvers.sparse,
    "matrix-free": linear_solvers.matrix_free,
}
MODULI, RATIOS, TIME_STEPS = (1e5, 1e7, 1e9), (0.3, 0.49), (1e-3, 1 / 60)
STEPS = 2
WORSE, RIGHT = 1.5, 0.9
"""Largest time by the chosen solver relative to the fastest other; smallest share of bodies with the best choice."""


def creature(quick: bool) -> Findings:
    """Steps per second of one crawler, and of many at once."""
    scene, muscles = crawling_scene()
    init, step = make_step(scene, TIME_STEP)
    controls = gait(200 if quick else 1000, muscles)

    def run(state: State, params: Params, controls: Any) -> Any:
        return rollout(functools.partial(step, params), state, controls, observe=positions_and_convergence)

    compiling, seconds, (_, (_, converged)) = timed(jax.jit(run), init(), scene.params, controls)
    alone = f"28 vertices, {len(controls)} steps; compiled in {compiling:.1f} s"
    rate = len(controls) / seconds
    controls = gait(100, muscles) * jnp.linspace(0.8, 1.0, LANES)[:, None, None]

    @jax.jit
    @jax.vmap
    def run_lane(controls: Any) -> Any:
        return rollout(functools.partial(step, scene.params), init(), controls)[0].x

    lanes, text = f"speed/{LANES}-crawlers", f"{LANES} gaits side by side by vmap, 100 steps each"
    lanes_rate = controls.shape[0] * controls.shape[1] / timed(run_lane, controls)[1]
    rows = [
        expect("speed/crawler", "steps_per_second", alone, rate, 6000.0, "1/s", at_least=True),
        *converges("speed/crawler", converged),
        expect(lanes, "environment_steps_per_second", text, lanes_rate, 15_000.0, "1/s", at_least=True),
    ]
    return Findings(rows)


def beams(quick: bool) -> Findings:
    """Time per step of cantilevers of 902 and 3402 unknowns that fall under their weight."""
    rows = []
    for cells, bound in (((40, 10), 8e-3), ((80, 20), 40e-3)):
        scene = cantilever_of(beam(4.0, 1.0, *cells))
        (init, step), steps = make_step(scene, DT), 10 if quick else 30

        def run(state: State, params: Params, step=step, steps=steps) -> Any:
            observe = lambda state, info: (info.iterations, info.converged)  # noqa: E731
            return rollout(functools.partial(step, params), state, steps=steps, observe=observe)

        compiling, seconds, (_, (iterations, converged)) = timed(jax.jit(run), init(), scene.params)
        name = f"speed/beam-{scene.mesh.vertices.size}-unknowns"
        text = f"{np.mean(np.asarray(iterations)):.1f} Newton iterations; compiled in {compiling:.1f} s"
        rows.append(expect(name, "seconds_per_step", text, seconds / steps, bound, "s"))
        rows += converges(name, converged)
    return Findings(rows)


def backward(quick: bool) -> Findings:
    """Time of reverse mode over that of the motion itself, 100 steps of the crawler."""
    loss, at = crawling(100, tolerance=1e-6)
    chosen = {"controls": ["controls"]} | ({} if quick else {"everything": list(at)})

    def slopes(at: Any, names: list[str]) -> Any:
        return jax.value_and_grad(lambda part: loss({**at, **part}))({name: at[name] for name in names})

    programs = {name: jax.jit(functools.partial(slopes, names=names)) for name, names in chosen.items()}
    # In turns, so that other load of the machine affects all of them.
    seconds = medians_in_turns({"motion": jax.jit(loss), **programs}, (at,), repetitions=30)
    rows = []
    for name in programs:
        ratio = seconds[name] / seconds["motion"] - 1
        text = f"the backward pass of a motion that takes {seconds['motion'] * 1e3:.1f} ms, in turns with it"
        rows.append(expect(f"speed/gradient-by-{name}", "backward_over_forward", text, ratio, 0.5))
    return Findings(rows)


def solver_choice(quick: bool) -> Findings:
    """Ratio of step times by the chosen linear solver and the fastest other, by stiffness and time step."""
    mesh = unordered_bar()
    programs = {name: bar_program(mesh, way) for name, way in WAYS.items()}
    rows, right = [], []
    for modulus, ratio, dt in itertools.product(MODULI[quick:], RATIOS[quick:], TIME_STEPS):
        scene = bar_scene(mesh, modulus, ratio)
        way = _choice(scene, dt)
        (chosen,) = (name for name in WAYS if WAYS[name] is getattr(way, "func", way))
        seconds = medians_in_turns(programs, (scene.params, dt), repetitions=3 if quick else 7, warm_up=1)
        other = min(set(WAYS) - {chosen}, key=lambda name: seconds[name])
        over = seconds[chosen] / seconds[other]
        right.append(over <= 1)
        text = f"{chosen} chosen; a step by {other} takes {seconds[other] / STEPS:.3g} s"
        where = f"speed/choice-{len(mesh.elements)}-tetrahedra/E={modulus:.0e}/nu={ratio}/dt={dt:.3g}"
        rows.append(expect(where, "chosen_over_other", text, over, WORSE))
    text = "share of these bodies that get the fastest solver"
    return Findings([*rows, expect("speed/choice", "share_right", text, np.mean(right), RIGHT, at_least=True)])


def unordered_bar(counts: tuple[int, int, int] = (10, 4, 4)) -> Mesh:
    """Tetrahedra between jittered points of a grid in 4 m x 1 m x 1 m, in random order: about a thousand by default."""
    random, cells, size = np.random.default_rng(0), np.array(counts), np.array([4.0, 1.0, 1.0])
    points = np.stack(np.meshgrid(*(np.arange(n + 1) for n in cells), indexing="ij"), axis=-1).reshape(-1, 3)
    inner = (points > 0) & (points < cells)
    points = random.permutation((points + 0.25 * inner * random.uniform(-1, 1, points.shape)) * size / cells)
    elements = Delaunay(points).simplices
    return make_mesh(points, elements[np.abs(regularity(points, elements)) > 0.02])


def bar_scene(mesh: Mesh, modulus: float, ratio: float) -> SoftScene:
    """The bar, held on the left, under its weight."""
    solid = elastic(mesh, stable_neo_hookean, youngs_modulus=modulus, poisson_ratio=ratio)
    return make_scene(mesh, [solid, gravity(mesh)], held=np.flatnonzero(mesh.vertices[:, 0] < 1e-9))


def bar_program(mesh: Mesh, way: linear_solvers.LinearSolverFactory) -> Any:
    """(params, dt) -> the bar after some steps, by one linear solver, compiled for any stiffness and time step."""
    scene = bar_scene(mesh, 1e6, 0.3)

    @jax.jit
    def run(params: Params, dt: Any) -> State:
        init, step = make_step(scene, dt, linear_solver=way)
        return rollout(functools.partial(step, params), init(), steps=STEPS)[0]

    return run


def bar_system(scene: SoftScene, dt: float) -> tuple[Any, Pattern, Any]:
    """(energies, their pattern, data) of a step of backward Euler from rest."""

    def inertia(x: Any, weight: Any) -> Any:
        return 0.5 * weight * sum(coordinate**2 for coordinate in x[0])

    rest, masses = scene.params.rest, scene.params.masses
    inertial = ElementEnergy(inertia, np.arange(len(rest))[:, None], unrolled=True)
    energies = (inertial, *element_energies(scene))
    at = pattern(energies, len(rest), rest.shape[1], scene.free)
    return energies, at, (masses / dt**2, *prepare(scene, scene.params, rest, dt=dt))


def _choice(scene: SoftScene, dt: float) -> linear_solvers.LinearSolverFactory:
    """The solver that `make_step` chooses for a step of backward Euler from rest."""
    energies, at, data = bar_system(scene, dt)
    takes = functools.partial(
        search_takes_at_most,
        energies=energies,
        at=at,
        x=scene.params.rest,
        data=data,
        residual=linear_solvers.SEARCH_RESIDUAL,
    )
    return selection.least_work(energies, at, takes)


def timed(function: Any, *arguments: Any) -> tuple[float, float, Any]:
    """Seconds to compile a jitted function, median seconds of a call, and what it returns."""
    began = time.perf_counter()
    compiled = function.lower(*arguments).compile()
    compiling = time.perf_counter() - began
    seconds = medians_in_turns({"": compiled}, arguments, repetitions=9, warm_up=1)[""]
    return compiling, seconds, jax.block_until_ready(compiled(*arguments))
