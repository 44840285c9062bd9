"""Times of steps, of reverse mode, of sparse factorisations and of compilation."""

import functools
import itertools
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import coo_array, csc_array, tril
from scipy.sparse.linalg import splu
from scipy.spatial import Delaunay

from dln_jax.rollout import rollout
from dln_jax.softbody import examples
from dln_jax.softbody.mesh.mesh import Mesh, make_mesh
from dln_jax.softbody.mesh.simplices import regularity
from dln_jax.softbody.scene import element_energies, prepare
from dln_jax.softbody.step import make_step, positions_and_convergence
from dln_jax.solvers.elements import linear_solvers
from dln_jax.solvers.elements.assembly import entries, pattern
from dln_jax.solvers.elements.energies import ElementEnergy, element_hessians
from scripts.reports.run import Numbers
from scripts.reports.timing import medians_in_turns

LANES = 64
BARS = ((10, 4, 4), (17, 6, 6), (36, 13, 13))
"""Numbers of cells along the edges of bars with 1,000, 4,000 and 41,000 tetrahedra."""


def moving(example: examples.Example, steps: int, dt: float | None = None, **options) -> tuple[Any, tuple]:
    """(params, controls, state) -> (positions, convergence) of a number of steps, and these arguments."""
    dt = example.dt if dt is None else dt
    init, step = make_step(example.scene, dt, **options)
    controls = None if example.control is None else jnp.asarray(example.control(dt * np.arange(steps)))

    def run(params, controls, state):
        observe = positions_and_convergence
        return rollout(functools.partial(step, params), state, controls, steps=steps, observe=observe)[1]

    return run, (example.scene.params, controls, init())


def crawler() -> examples.Example:
    """The crawler of 28 vertices, with a wave of muscle lengths of 0.7 to 1 that runs along the body in 20 steps."""
    example = examples.creature()
    assert example.muscles is not None
    muscles = len(example.muscles)

    def control(t):
        phase = t[:, None] / (20 * example.dt) - np.arange(muscles) / muscles
        return 0.85 + 0.15 * np.sin(2 * np.pi * phase)

    return example._replace(control=control)


def creature(*, steps: int = 1000) -> Numbers:
    """Steps per second of one crawler, and of many gaits side by side by vmap, 100 steps each."""
    run, arguments = moving(crawler(), steps)
    alone = jax.jit(run)
    seconds = medians_in_turns({"": alone}, arguments, repetitions=9)[""]
    run, (params, controls, state) = moving(crawler(), 100)
    lanes = controls * jnp.linspace(0.8, 1.0, LANES)[:, None, None]
    together = jax.jit(jax.vmap(lambda controls: run(params, controls, state)[0][-1]))
    lanes_seconds = medians_in_turns({"": together}, (lanes,), repetitions=9)[""]
    return {
        "speed/crawler": {
            "steps_per_second": steps / seconds,
            "steps_not_converged": np.sum(~np.asarray(alone(*arguments)[1])),
        },
        f"speed/{LANES}-crawlers": {"environment_steps_per_second": 100 * LANES / lanes_seconds},
    }


def backward(*, repetitions: int = 30) -> Numbers:
    """Time of reverse mode over that of the motion itself, 100 steps of the crawler.

    Everything: actuation, all parameters of the scene, and positions and velocities at the start.
    """
    distance, arguments = crawling()
    chosen = {"controls": 1, "everything": (0, 1, 2, 3)}
    slopes = {name: jax.jit(jax.value_and_grad(distance, places)) for name, places in chosen.items()}
    programs = {"motion": jax.jit(distance), **slopes}
    seconds = medians_in_turns(programs, arguments, repetitions=repetitions)
    return {
        f"speed/gradient-by-{name}": {"backward_over_forward": seconds[name] / seconds["motion"] - 1} for name in chosen
    }


def crawling() -> tuple[Callable[..., Any], tuple]:
    """Distance of the crawler after 100 steps, m: a function of parameters, actuation, positions and velocities."""
    run, (params, controls, state) = moving(crawler(), 100)

    def distance(params, controls, x, v):
        return run(params, controls, state._replace(x=x, v=v))[0][-1, :, 0].mean()

    return distance, (params, controls, state.x, state.v)


def beams(*, steps: int = 30) -> Numbers:
    """Time per step of 1/30 s of beams of 902 and 3402 unknowns, E = 1e6 Pa, that fall under their weight."""
    numbers = {}
    for cells in (10, 20):
        example = examples.beam(cells=cells, youngs_modulus=1e6)
        run, arguments = moving(example, steps, dt=1 / 30)
        program = jax.jit(run)
        numbers[f"speed/beam-{example.scene.mesh.vertices.size}-unknowns"] = {
            "seconds_per_step": medians_in_turns({"": program}, arguments, repetitions=9)[""] / steps,
            "steps_not_converged": np.sum(~np.asarray(program(*arguments)[1])),
        }
    return numbers


def stiffness(*, bars: int = 3) -> Numbers:
    """Processor time per step over Young's modulus and Poisson's ratio, by the sparse factorisation."""
    numbers = {}
    for cells in BARS[:bars]:
        mesh, seconds, solved = unordered_bar(cells), [], True
        run, (_, controls, state) = moving(examples.beam(mesh=mesh), 2, linear_solver=linear_solvers.sparse)
        program = jax.jit(run)
        for modulus, ratio in itertools.product((3e5, 1e7, 1e9), (0.3, 0.49)):
            example = examples.beam(mesh=mesh, youngs_modulus=modulus, poisson_ratio=ratio)
            arguments = example.scene.params, controls, state
            seconds.append(processor_seconds(functools.partial(program, *arguments), 3) / 2)
            solved &= bool(program(*arguments)[1].all())
        numbers[f"speed/stiffness-{len(mesh.elements)}-tetrahedra"] = {
            "slowest_over_fastest_step": max(seconds) / min(seconds),
            "fastest_seconds_per_step": min(seconds),
            "slowest_seconds_per_step": max(seconds),
            "converged": float(solved),
        }
    return numbers


def factorisation(*, bars: int = 3) -> Numbers:
    """Processor time of a factorisation and solve beside SciPy's LU, whose order is the better of two."""
    numbers = {}
    for cells in BARS[:bars]:
        scene = examples.beam(mesh=unordered_bar(cells), youngs_modulus=1e6).scene
        rest = scene.params.rest

        def inertia(x, weight):
            return 0.5 * weight * sum(coordinate**2 for coordinate in x[0])

        # A step of backward Euler from rest.
        inertial = ElementEnergy(inertia, np.arange(len(rest))[:, None], unrolled=True)
        energies = (inertial, *element_energies(scene))
        at = pattern(energies, len(rest), rest.shape[1], scene.free)
        data = (60.0**2 * scene.params.masses, *prepare(scene, scene.params, rest, dt=1 / 60))
        values = jax.jit(lambda x, data, e=energies, at=at: entries(at, element_hessians(e, x, data)))(rest, data)
        solver, b = linear_solvers.sparse(energies, at), jnp.where(at.free, 1.0, 0.0)
        solve = jax.jit(lambda values, b, solver=solver: solver.solve(solver.factorise((), values), b))
        lower = csc_array(coo_array((np.asarray(values), (at.rows, at.columns)), shape=(at.unknowns,) * 2))
        free = np.flatnonzero(at.free)
        matrix = csc_array(csc_array(lower + tril(lower, -1).T)[free][:, free])
        right = np.ones(len(free))

        def by_scipy(order, matrix=matrix, right=right):
            symmetric = {"SymmetricMode": True}
            return splu(matrix, permc_spec=order, diag_pivot_thresh=0.0, options=symmetric).solve(right)

        ours = processor_seconds(functools.partial(solve, values, b), 5)
        scipy = min(processor_seconds(functools.partial(by_scipy, o), 2) for o in ("MMD_AT_PLUS_A", "COLAMD"))
        numbers[f"speed/factorisation-{at.unknowns}-unknowns"] = {
            "factor_and_solve_over_scipy": ours / scipy,
            "factor_and_solve_seconds": ours,
            "scipy_seconds": scipy,
            "residual": np.abs(matrix @ np.ravel(solve(values, b))[free] - right).max(),
        }
    return numbers


def unordered_bar(counts: tuple[int, int, int]) -> Mesh:
    """Tetrahedra between jittered points of a grid in 4 m x 1 m x 1 m, in random order."""
    random, cells, size = np.random.default_rng(0), np.array(counts), np.array([4.0, 1.0, 1.0])
    points = np.stack(np.meshgrid(*(np.arange(n + 1) for n in cells), indexing="ij"), axis=-1).reshape(-1, 3)
    inner = (points > 0) & (points < cells)
    points = random.permutation((points + 0.25 * inner * random.uniform(-1, 1, points.shape)) * size / cells)
    elements = Delaunay(points).simplices
    return make_mesh(points, elements[np.abs(regularity(points, elements)) > 0.02])


def processor_seconds(function: Callable[[], Any], repetitions: int) -> float:
    """Least processor time of a call after the first, which other programs on the machine affect less than its wall."""
    jax.block_until_ready(function())
    spent = []
    for _ in range(repetitions):
        began = time.process_time()
        jax.block_until_ready(function())
        spent.append(time.process_time() - began)
    return min(spent)


def compilation(*, programs: tuple[str, ...] = ("box-on-ground", "self-contact", "crawler-gradient")) -> Numbers:
    """Time until the first step of a box on the ground and of a bar that can touch itself, and until a gradient.

    Two cores compile in parallel, so that the sum is less than the processor time.
    """
    numbers = {}
    for name in programs:
        if name == "crawler-gradient":
            distance, arguments = crawling()
            function = jax.value_and_grad(distance, (0, 1, 2, 3))
        else:
            example = examples.drop(dimension=3) if name == "box-on-ground" else examples.twist(contact=True)
            init, function = make_step(example.scene, example.dt)
            arguments = (example.scene.params, init())
        # With a constant of its own, the program is in no cache.
        stamp, began = time.time_ns(), time.perf_counter()
        fresh = jax.jit(lambda *arguments, function=function, stamp=stamp: (function(*arguments), jnp.asarray(stamp)))
        lowered = fresh.trace(*arguments).lower()
        at_lower = time.perf_counter()
        lowered.compile()
        parts = {"trace_and_lower_seconds": at_lower - began, "compile_seconds": time.perf_counter() - at_lower}
        numbers[f"compile/{name}"] = {"seconds": sum(parts.values()), **parts}
    return numbers
