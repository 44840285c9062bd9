"""Shared parts of the soft-body cases: a solid under its weight, its motion, and the check of convergence."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from dln_jax.rollout import rollout
from dln_jax.softbody.mesh.mesh import Mesh, vertices_where
from dln_jax.softbody.scene import Params, SoftScene, State, make_scene
from dln_jax.softbody.step import Step
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.gravity import gravity
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean
from dln_jax.softbody.verdict import Info
from scripts.reports.rows import Row, expect, largest

GRAVITY = 9.8
"""Gravity of the reference values, m/s²."""


class Seen(NamedTuple):
    """Observations after T steps."""

    x: Float[np.ndarray, "T n dim"]
    v: Float[np.ndarray, "T n dim"]
    iterations: Int[np.ndarray, " T"]
    converged: Bool[np.ndarray, " T"]


def cantilever_of(mesh: Mesh, modulus: float = 1e6, **others: Any) -> SoftScene:
    """A solid held at x = 0; a beam of 4 m x 1 m and 1e6 Pa sags by about its length."""
    material = elastic(mesh, stable_neo_hookean, youngs_modulus=modulus)
    held = vertices_where(mesh, lambda x: x[:, 0] == 0)
    return make_scene(mesh, [material, gravity(mesh, (0.0, -GRAVITY))], held=held, **others)


def converges(name: str, converged: Any, iterations: Any = None, most: int = 0, text: str = "") -> list[Row]:
    """Rows of the number of steps that did not converge, and of the largest number of iterations if it has a bound."""
    count = np.sum(~np.asarray(converged))
    rows = [expect(name, "steps_not_converged", "every step converges", count, 0.0)]
    return rows if iterations is None else [*rows, expect(name, "most_iterations", text, largest(iterations), most)]


def motion(step: Step, steps: int) -> Callable[[Params, State], Seen]:
    """(params, state) -> observations of `steps` steps, compiled at the first call."""

    def observe(state: State, info: Info) -> tuple:
        return state.x, state.v, info.iterations, info.converged

    @jax.jit
    def program(params: Params, state: State) -> tuple:
        return rollout(functools.partial(step, params), state, steps=steps, observe=observe)[1]

    return lambda params, state: Seen(*map(np.asarray, program(params, state)))
