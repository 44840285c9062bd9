"""Whether the linear solver that a scene's stiffness chooses is the faster one, on bodies of unordered tetrahedra."""

import functools
import itertools
from typing import Any

import jax
import numpy as np
from scipy.spatial import Delaunay

from dln_jax.metrics.latency import medians_in_turns
from dln_jax.rollout import rollout
from dln_jax.softbody.mesh.mesh import Mesh, make_mesh
from dln_jax.softbody.mesh.simplices import regularity
from dln_jax.softbody.scene import Params, SoftScene, State, element_energies, make_scene, prepare
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.gravity import gravity
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean
from dln_jax.solvers.elements import linear_solvers
from dln_jax.solvers.elements.assembly import pattern
from dln_jax.solvers.elements.energies import ElementEnergy
from dln_jax.solvers.elements.selection import least_work, search_takes_at_most
from scripts.reports.case import Findings
from scripts.reports.rows import expect

WAYS = {"blocks": linear_solvers.block_tridiagonal, "matrix-free": linear_solvers.matrix_free}
MODULI, RATIOS, TIME_STEPS = (1e5, 1e7, 1e9), (0.3, 0.49), (1e-3, 1 / 60)
STEPS = 2
WORSE, RIGHT = 1.5, 0.9
"""Largest time by the chosen solver relative to the other, and smallest share of bodies with the faster choice."""


def solver_choice(quick: bool) -> Findings:
    """Ratio of step times by the chosen linear solver and the other, by stiffness and time step."""
    mesh = unordered_bar()
    programs = {name: _program(mesh, way) for name, way in WAYS.items()}
    rows, right = [], []
    for modulus, ratio, dt in itertools.product(MODULI[quick:], RATIOS[quick:], TIME_STEPS):
        scene = _bar(mesh, modulus, ratio)
        chosen = "matrix-free" if _choice(scene, dt) is linear_solvers.matrix_free else "blocks"
        (other,) = set(WAYS) - {chosen}
        seconds = medians_in_turns(programs, (scene.params, dt), repetitions=3 if quick else 7, warm_up=1)
        over = seconds[chosen] / seconds[other]
        right.append(over <= 1)
        text = f"{chosen} chosen; a step by {other} takes {seconds[other] / STEPS:.3g} s"
        where = f"speed/choice-{len(mesh.elements)}-tetrahedra/E={modulus:.0e}/nu={ratio}/dt={dt:.3g}"
        rows.append(expect(where, "chosen_over_other", text, over, WORSE))
    text = "share of these bodies for which the faster solver is chosen"
    return Findings([*rows, expect("speed/choice", "share_right", text, np.mean(right), RIGHT, at_least=True)])


def unordered_bar() -> Mesh:
    """About a thousand tetrahedra between jittered points of a grid in 4 m x 1 m x 1 m, in random order."""
    random, cells, size = np.random.default_rng(0), np.array([10, 4, 4]), np.array([4.0, 1.0, 1.0])
    points = np.stack(np.meshgrid(*(np.arange(n + 1) for n in cells), indexing="ij"), axis=-1).reshape(-1, 3)
    inner = (points > 0) & (points < cells)
    points = random.permutation((points + 0.25 * inner * random.uniform(-1, 1, points.shape)) * size / cells)
    elements = Delaunay(points).simplices
    return make_mesh(points, elements[np.abs(regularity(points, elements)) > 0.02])


def _bar(mesh: Mesh, modulus: float, ratio: float) -> SoftScene:
    solid = elastic(mesh, stable_neo_hookean, youngs_modulus=modulus, poisson_ratio=ratio)
    return make_scene(mesh, [solid, gravity(mesh)], held=np.flatnonzero(mesh.vertices[:, 0] < 1e-9))


def _program(mesh: Mesh, way: linear_solvers.LinearSolverFactory) -> Any:
    """(params, dt) -> the bar after some steps, by one linear solver, compiled for any stiffness and time step."""
    scene = _bar(mesh, 1e6, 0.3)

    @jax.jit
    def run(params: Params, dt: Any) -> State:
        init, step = make_step(scene, dt, linear_solver=way)
        return rollout(functools.partial(step, params), init(), steps=STEPS)[0]

    return run


def _choice(scene: SoftScene, dt: float) -> linear_solvers.LinearSolverFactory:
    """The solver that `make_step` chooses for a step of backward Euler from rest."""
    rest, masses = scene.params.rest, scene.params.masses
    inertia = ElementEnergy(_inertia, np.arange(len(rest))[:, None], unrolled=True)
    energies = (inertia, *element_energies(scene))
    at = pattern(energies, len(rest), rest.shape[1], scene.free)
    data = (masses / dt**2, *prepare(scene, scene.params, rest, dt=dt))
    takes = functools.partial(
        search_takes_at_most, energies=energies, at=at, x=rest, data=data, residual=linear_solvers.SEARCH_RESIDUAL
    )
    return least_work(energies, at, takes)


def _inertia(x: Any, weight: Any) -> Any:
    return 0.5 * weight * sum(coordinate**2 for coordinate in x[0])
