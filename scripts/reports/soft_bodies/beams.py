"""Beams and bars: convergence over time steps and materials, times of steps, of factorisations and of compilation."""

import functools
import itertools
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.sparse import coo_array, csc_array, tril
from scipy.sparse.linalg import splu
from scipy.spatial import Delaunay

from dln_jax.rollout import rollout
from dln_jax.softbody import SoftScene, examples, make_scene, make_step, with_parameters
from dln_jax.softbody.mesh import Mesh, beam, make_mesh, vertices_where
from dln_jax.softbody.mesh.simplices import regularity
from dln_jax.softbody.scene import element_energies, prepare
from dln_jax.softbody.step import Step
from dln_jax.softbody.terms import elastic, gravity, stable_neo_hookean
from dln_jax.solvers.elements import linear_solvers
from dln_jax.solvers.elements.assembly import entries, pattern
from dln_jax.solvers.elements.energies import ElementEnergy, element_hessians
from scripts.reports.run import Numbers
from scripts.reports.soft_bodies.gradients import crawling
from scripts.reports.timing import medians_in_turns

DT = 1 / 30
BARS = ((10, 4, 4), (17, 6, 6), (36, 13, 13))
"""Numbers of cells along the edges of bars with 1,000, 4,000 and 41,000 tetrahedra."""


def cantilever(cells: tuple[int, int]) -> SoftScene:
    """A beam of 4 m x 1 m and 1e6 Pa, held at x = 0, which sags by about its length."""
    mesh = beam(4.0, 1.0, *cells)
    material = elastic(mesh, stable_neo_hookean, youngs_modulus=1e6)
    return make_scene(mesh, [material, gravity(mesh, (0.0, -9.8))], held=vertices_where(mesh, lambda x: x[:, 0] == 0))


def motion(step: Step, steps: int) -> Callable[..., tuple[Array, Array]]:
    """(params, state) -> iterations and convergence of `steps` steps."""
    observe = lambda state, info: (info.iterations, info.converged)  # noqa: E731
    return jax.jit(
        lambda params, state: rollout(functools.partial(step, params), state, steps=steps, observe=observe)[1]
    )


def seen(iterations: Any, converged: Any) -> dict[str, float]:
    """Steps that did not converge, and the largest number of Newton iterations."""
    return {"steps_not_converged": np.sum(~np.asarray(converged)), "most_iterations": np.max(np.asarray(iterations))}


def time_steps(
    *, lengths: tuple[float, ...] = (1e-3, 1e-2, 1e-1, 1.0, 10.0), cells: tuple[int, int] = (40, 10)
) -> Numbers:
    """The first steps from rest, of 1 ms to 10 s, of a beam that falls under its weight."""
    scene, numbers = cantilever(cells), {}
    for dt in lengths:
        init, step = make_step(scene, dt)
        numbers[f"time-step/{dt:g}-s"] = seen(*motion(step, 3)(scene.params, init()))
    return numbers


def materials(*, cells: tuple[int, int] = (40, 10)) -> Numbers:
    """Two seconds of a beam from soft to stiff and from compressible to nearly incompressible, by one program."""
    scene, numbers = cantilever(cells), {}
    init, step = make_step(scene, DT)
    run = motion(step, 60)
    table = [(f"modulus/{modulus:.0e}", modulus, 0.3) for modulus in (1e4, 1e6, 1e8, 1e10)]
    table += [(f"poisson/{ratio}", 1e6, ratio) for ratio in (0.4, 0.49, 0.4999)]
    for name, modulus, ratio in table:
        material = {"youngs_modulus": modulus, "poisson_ratio": ratio}
        iterations, converged = run(with_parameters(scene.params, elastic=material), init())
        at_first = np.max(np.asarray(iterations[:3]))
        numbers[name] = seen(iterations, converged) | {"most_iterations_at_first": at_first}
    return numbers


def beams(*, steps: int = 30) -> Numbers:
    """Time per step of cantilevers of 902 and 3402 unknowns that fall under their weight."""
    numbers = {}
    for cells in ((40, 10), (80, 20)):
        scene = cantilever(cells)
        init, step = make_step(scene, DT)
        program, arguments = motion(step, steps), (scene.params, init())
        seconds = medians_in_turns({"": program}, arguments, repetitions=9)[""] / steps
        numbers[f"speed/beam-{scene.mesh.vertices.size}-unknowns"] = {
            "seconds_per_step": seconds,
            "steps_not_converged": np.sum(~np.asarray(program(*arguments)[1])),
        }
    return numbers


def stiffness(*, bars: int = 3) -> Numbers:
    """Processor time per step over Young's modulus and Poisson's ratio, by the sparse factorisation."""
    numbers, dt = {}, 1 / 60
    for cells in BARS[:bars]:
        mesh = unordered_bar(cells)
        init, step = make_step(bar_scene(mesh), dt, linear_solver=linear_solvers.sparse)
        run, seconds, solved = motion(step, 2), [], True
        for modulus, ratio in itertools.product((3e5, 1e7, 1e9), (0.3, 0.49)):
            arguments = bar_scene(mesh, modulus, ratio).params, init()
            seconds.append(processor_seconds(functools.partial(run, *arguments), 3) / 2)
            solved &= bool(run(*arguments)[1].all())
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
        scene = bar_scene(unordered_bar(cells))
        rest = scene.params.rest

        def inertia(x: Any, weight: Any) -> Any:
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

        def by_scipy(order: str, matrix: Any = matrix, right: Any = right) -> Any:
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


def bar_scene(mesh: Mesh, modulus: float = 1e6, ratio: float = 0.3) -> SoftScene:
    """The bar, held on the left, under its weight."""
    solid = elastic(mesh, stable_neo_hookean, youngs_modulus=modulus, poisson_ratio=ratio)
    return make_scene(mesh, [solid, gravity(mesh)], held=np.flatnonzero(mesh.vertices[:, 0] < 1e-9))


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
            loss, at = crawling(100, tolerance=1e-6)
            function, arguments = jax.value_and_grad(loss), (at,)
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
