"""What the cases of soft bodies share."""

from collections.abc import Callable
from typing import Any

import jax

from dln_jax.softbody.rollout import rollout
from dln_jax.softbody.scene import Params, SoftScene, State
from dln_jax.softbody.step import Integrator, make_step
from dln_jax.solvers.elements.minimise import Info

GRAVITY = 9.8
"""In m/s², of the reference values."""


def positions_and_velocities(state: State, info: Info) -> tuple[Any, Any, Any]:
    """x, v [n, dim], and whether the step converged."""
    return state.x, state.v, info.converged


def motion(
    scene: SoftScene, dt: float, steps: int, integrator: Integrator = "backward-euler", **options: Any
) -> Callable[..., Any]:
    """(state, params, controls) -> (x [steps, n, dim], v, converged [steps]), compiled at its first call."""
    step = make_step(scene, dt, integrator, **options)

    def run(state: State, params: Params, controls: Any = None) -> Any:
        observe = positions_and_velocities
        return rollout(step, state, params, controls, steps=None if controls is not None else steps, observe=observe)[1]

    return jax.jit(run)
