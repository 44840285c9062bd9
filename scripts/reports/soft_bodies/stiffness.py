"""The sparse factorisation: time per step over the stiffness, and its own time beside SciPy's LU factorisation."""

import functools
import itertools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import coo_array, csc_array, tril
from scipy.sparse.linalg import splu

from dln_jax.softbody.step import make_step
from dln_jax.solvers.elements import linear_solvers
from dln_jax.solvers.elements.assembly import entries
from dln_jax.solvers.elements.energies import element_hessians
from scripts.reports.case import Findings
from scripts.reports.rows import expect
from scripts.reports.soft_bodies.speed import bar_scene, bar_system, unordered_bar

CELLS = ((10, 4, 4), (17, 6, 6), (36, 13, 13))
"""Numbers of cells along the edges of bars with 1,000, 4,000 and 41,000 tetrahedra."""
MODULI, RATIOS, DT = (3e5, 1e7, 1e9), (0.3, 0.49), 1 / 60
STEPS = 2
SPREAD, OVER_SCIPY = 2.0, 1.5


def steps(quick: bool) -> Findings:
    """Processor time per step over Young's modulus and Poisson's ratio, by the sparse factorisation."""
    rows = []
    for cells in CELLS[: 2 if quick else 3]:
        mesh = unordered_bar(cells)
        scene = bar_scene(mesh, 1e6, 0.3)
        init, step = make_step(scene, DT, linear_solver=linear_solvers.sparse)

        @jax.jit
        def run(params: Any, init: Any = init, step: Any = step) -> Any:
            return jax.lax.scan(lambda state, _: step(params, state), init(), length=STEPS)

        seconds, solved = {}, True
        for modulus, ratio in itertools.product(MODULI, RATIOS):
            params = bar_scene(mesh, modulus, ratio).params
            run_one = functools.partial(run, params)
            seconds[modulus, ratio] = processor_seconds(run_one, 3) / STEPS
            solved &= bool(run_one()[1].converged.all())
        slowest, fastest = max(seconds.values()), min(seconds.values())
        name = f"speed/stiffness-{len(mesh.elements)}-tetrahedra"
        text = f"E 3e5 to 1e9 Pa, nu 0.3 and 0.49; {fastest:.3g} to {slowest:.3g} s of processor time a step"
        rows += [
            expect(name, "slowest_over_fastest_step", text, slowest / fastest, SPREAD),
            expect(name, "converged", "all steps", solved, 1, at_least=True),
        ]
    return Findings(rows)


def factorisation(quick: bool) -> Findings:
    """Processor time of a factorisation and solve relative to SciPy's, whose order is the better of two."""
    rows = []
    for cells in CELLS[: 2 if quick else 3]:
        scene = bar_scene(unordered_bar(cells), 1e6, 0.3)
        energies, at, data = bar_system(scene, DT)
        hessians = jax.jit(functools.partial(element_hessians, energies))(scene.params.rest, data)
        values = jax.jit(functools.partial(entries, at))(hessians)
        b = jnp.where(at.free, 1.0, 0.0)
        solver = linear_solvers.sparse(energies, at)
        solve = jax.jit(lambda values, b, solver=solver: solver.solve(solver.factorise((), values), b))
        lower = csc_array(coo_array((np.asarray(values), (at.rows, at.columns)), shape=(at.unknowns,) * 2))
        free = np.flatnonzero(at.free)
        matrix = csc_array(csc_array(lower + tril(lower, -1).T)[free][:, free])
        right = np.ones(len(free))
        residual = np.abs(matrix @ np.ravel(solve(values, b))[free] - right).max()
        ours = processor_seconds(functools.partial(solve, values, b), 5)

        def by_scipy(order: str, matrix: Any = matrix, right: Any = right) -> Any:
            symmetric = {"SymmetricMode": True}
            return splu(matrix, permc_spec=order, diag_pivot_thresh=0.0, options=symmetric).solve(right)

        scipy = min(processor_seconds(functools.partial(by_scipy, o), 2) for o in ("MMD_AT_PLUS_A", "COLAMD"))
        name = f"speed/factorisation-{at.unknowns}-unknowns"
        text = f"{ours:.3g} s of processor time, SciPy's LU {scipy:.3g} s; residual {residual:.0e}"
        rows.append(expect(name, "factor_and_solve_over_scipy", text, ours / scipy, OVER_SCIPY))
    return Findings(rows)


def processor_seconds(function: Any, repetitions: int) -> float:
    """Least processor time of a call after the first, which other programs on the machine affect less than its wall."""
    jax.block_until_ready(function())
    least = np.inf
    for _ in range(repetitions):
        began = time.process_time()
        jax.block_until_ready(function())
        least = min(least, time.process_time() - began)
    return least
