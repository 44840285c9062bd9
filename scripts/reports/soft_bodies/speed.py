"""How fast steps, gradients and linear solvers are: compiled apart, medians, results waited for."""

import functools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.metrics.latency import medians_in_turns
from dln_jax.rollout import rollout
from dln_jax.softbody.mesh.shapes import beam, box
from dln_jax.softbody.scene import Params, State, element_energies, make_scene, prepare
from dln_jax.softbody.step import INTEGRATORS, MIDPOINT, Integrator, make_step, positions_and_convergence
from dln_jax.softbody.terms.creature import TIME_STEP
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean
from dln_jax.solvers.elements.assembly import entries, pattern
from dln_jax.solvers.elements.energies import ElementEnergy, element_hessians
from dln_jax.solvers.elements.linear_solvers import block_tridiagonal, dense, matrix_free
from scripts.reports.case import Findings
from scripts.reports.rows import expect, largest
from scripts.reports.soft_bodies.common import cantilever_of, converges
from scripts.reports.soft_bodies.gradients import crawling, crawling_scene, gait

LANES = 64
DT = 1 / 30
LIMIT = 20.0
"""Time limit, s; measurements that would take longer are left out."""
PROTOTYPE = {
    243: {"dense": 0.5e-3, "block-tridiagonal": 0.4e-3},
    902: {"dense": 9.5e-3, "block-tridiagonal": 1.0e-3},
    1275: {"dense": 23e-3, "block-tridiagonal": 3.1e-3},
    3402: {"dense": 286e-3, "block-tridiagonal": 5.6e-3},
    8019: {"block-tridiagonal": 211e-3},
}
"""Reference times of a factorisation and solve, s, by number of unknowns and solver, on two cores."""


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
        converges("speed/crawler", converged),
        expect(lanes, "environment_steps_per_second", text, lanes_rate, 15_000.0, "1/s", at_least=True),
    ]
    return Findings(rows)


def beams(quick: bool) -> Findings:
    """Time per step of cantilevers of 902 and 3402 unknowns that fall under their weight."""
    cases = []
    for cells, bound in (((40, 10), 8e-3), ((80, 20), 40e-3)):
        scene = cantilever_of(beam(4.0, 1.0, *cells))
        (init, step), steps = make_step(scene, DT), 10 if quick else 30

        def run(state: State, params: Params, step=step, steps=steps) -> Any:
            observe = lambda state, info: (info.iterations, info.converged)  # noqa: E731
            return rollout(functools.partial(step, params), state, steps=steps, observe=observe)

        compiling, seconds, (_, (iterations, converged)) = timed(jax.jit(run), init(), scene.params)
        name = f"speed/beam-{scene.mesh.vertices.size}-unknowns"
        text = f"{np.mean(np.asarray(iterations)):.1f} Newton iterations; compiled in {compiling:.1f} s"
        cases.append(expect(name, "seconds_per_step", text, seconds / steps, bound, "s"))
        cases.append(converges(name, converged))
    return Findings(cases)


def backward(quick: bool) -> Findings:
    """Time of reverse mode over that of the motion itself, 100 steps of the crawler."""
    loss, at = crawling(100, tolerance=1e-6)
    chosen = {"controls": ["controls"]} | ({} if quick else {"everything": list(at)})

    def slopes(at: Any, names: list[str]) -> Any:
        return jax.value_and_grad(lambda part: loss({**at, **part}))({name: at[name] for name in names})

    programs = {name: jax.jit(functools.partial(slopes, names=names)) for name, names in chosen.items()}
    # In turns, so that what else the machine does falls on all of them.
    seconds = medians_in_turns({"motion": jax.jit(loss), **programs}, (at,), repetitions=30)
    cases = []
    for name in programs:
        ratio = seconds[name] / seconds["motion"] - 1
        text = f"the backward pass of a motion that takes {seconds['motion'] * 1e3:.1f} ms, in turns with it"
        cases.append(expect(f"speed/gradient-by-{name}", "backward_over_forward", text, ratio, 0.5))
    return Findings(cases)


def linear_solvers(quick: bool) -> Findings:
    """Time per factor-and-solve of each linear solver by the number of unknowns."""
    cases, curves = [], {}
    solvers = {"dense": dense, "block-tridiagonal": block_tridiagonal, "matrix-free": matrix_free}
    for cells in ((8, 2, 2), (40, 10), (16, 4, 4), (80, 20), *(() if quick else ((32, 8, 8),))):
        mesh = beam(4.0, 1.0, *cells) if len(cells) == 2 else box((4.0, 1.0, 1.0), cells)
        material = elastic(mesh, stable_neo_hookean, youngs_modulus=1e6, poisson_ratio=0.4)
        scene = make_scene(mesh, [material])
        rest, masses = scene.params.rest, scene.params.masses
        inertia = ElementEnergy(_inertia, np.arange(len(rest))[:, None], unrolled=True)
        energies = (inertia, *element_energies(scene))
        at = pattern(energies, *rest.shape)
        data = (masses / DT**2, *prepare(scene, scene.params, rest, dt=DT))
        hessians = jax.jit(lambda rest, data, of=energies: element_hessians(of, rest, data))(rest, data)
        values = jax.jit(lambda hessians, at=at: entries(at, hessians))(hessians)
        b = jnp.asarray(np.random.default_rng(0).normal(size=rest.shape))
        for name, factory in solvers.items():
            sizes, times = curves.setdefault(name, ([], []))
            if sizes and times[-1] * (at.unknowns / sizes[-1]) ** 3 > LIMIT:
                continue
            solver = factory(energies, at)
            run = jax.jit(lambda h, v, b, solver=solver: solver.solve(solver.factorise(h, v), b))
            _, seconds, p = timed(run, hessians, values, b, repeats=3)
            sizes.append(at.unknowns)
            times.append(seconds)
            text = "as accurate as rounding allows" if name != "matrix-free" else "to a relative residual of 1e-10"
            assert np.isfinite(np.asarray(p)).all()
            where, reference = f"speed/{name}/{at.unknowns}-unknowns", PROTOTYPE[at.unknowns].get(name)
            cases.append(expect(where, "seconds_per_solve", text, seconds, LIMIT, "s", reference=reference))
    return Findings(cases, curves)


def _inertia(x: Any, weight: Any) -> Any:
    return 0.5 * weight * sum(coordinate**2 for coordinate in x[0])


def speed_against_error(quick: bool) -> Findings:
    """Error of a swing of a beam against the time step, and how many steps and simulated seconds a second brings."""
    scene = cantilever_of(beam(4.0, 1.0, 8, 2), modulus=1e7)
    duration, counts = 0.4, (20, 80) if quick else (10, 40, 160)
    texts = {}
    curves: dict[str, Any] = {"dt": duration / np.array(counts)}
    exact = _swung(scene, MIDPOINT, duration, 1600)[0]
    moved = largest(abs(exact - scene.mesh.vertices))
    for name, integrator in INTEGRATORS.items():
        errors, rates = [], []
        for count in counts:
            x, seconds = _swung(scene, integrator, duration, count)
            errors.append(largest(abs(x - exact)) / moved)
            rates.append(count / seconds)
        pairs = zip(errors, np.array(counts) / rates, strict=True)
        spent = ", ".join(f"{error:.1g} at {seconds:.2g} s" for error, seconds in pairs)
        texts[name] = f"error of the motion against seconds: {spent}"
        curves[name] = (np.array(errors), np.array(rates))
    first, gain = curves["backward-euler"][0], "error_gain_over_backward_euler"
    gains = {"backward-euler": ("error_gain_by_shorter_steps", first[0] / first[-1])}
    gains |= {name: (gain, first[-1] / curves[name][0][-1]) for name in ("bdf2", "midpoint")}
    rows = [expect(f"speed/{name}", what, texts[name], by, 2.0, at_least=True) for name, (what, by) in gains.items()]
    return Findings(rows, curves)


def _swung(scene: Any, integrator: Integrator, duration: float, count: int) -> tuple[np.ndarray, float]:
    init, step = make_step(scene, duration / count, integrator)
    run = jax.jit(lambda state, params: rollout(functools.partial(step, params), state, steps=count)[0].x)
    _, seconds, x = timed(run, init(), scene.params, repeats=3)
    return np.asarray(x), seconds


def timed(function: Any, *arguments: Any, repeats: int = 9) -> tuple[float, float, Any]:
    """Seconds to compile a jitted function, median seconds of a call, and what it returns."""
    began = time.perf_counter()
    compiled = function.lower(*arguments).compile()
    compiling = time.perf_counter() - began
    seconds = medians_in_turns({"": compiled}, arguments, repetitions=repeats, warm_up=1)[""]
    return compiling, seconds, jax.block_until_ready(compiled(*arguments))
