"""The same work on one device and on several devices of this process."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh

from dln_jax.learning.engine import descent, newton
from dln_jax.learning.engine.optimisers import Adam, GaussNewton
from dln_jax.learning.engine.problem import Problem, unmonitored
from dln_jax.learning.engine.problem import sharing as sharing_of
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.lagrangian import make_delan
from dln_jax.rollout import rollout
from dln_jax.scale.mesh import batch_mesh, program, replicate, spread
from dln_jax.scale.processes import host_devices
from dln_jax.scenes.datasets.generators import uniform
from dln_jax.scenes.pendulums import two_link_arm
from dln_jax.softbody.examples import creature_scene
from dln_jax.softbody.mesh.shapes import crawler
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.creature import TIME_STEP
from scripts.reports.run import Numbers
from scripts.reports.timing import medians_in_turns

SPEED = 0.3
"""Standard deviation of the vertices' initial velocities, m/s: crawlers then differ in their iterations."""
TRAININGS = {"adam": 200, "gauss-newton": 5}
"""Steps of a piece of work by optimiser."""

Work = tuple[Callable[[], tuple], Callable[..., Any], dict[str, float]]
"""What makes the arguments of a program, the compiled program, and further numbers of it."""


def measure_crawlers(*, lanes: int = 64, steps: int = 10, sharing: int = 2, turns: int = 5) -> Numbers:
    """Seconds of a step of one of many soft crawlers, stepped side by side.

    Args:
        lanes: crawlers side by side.
        sharing: devices that share them.
    """
    host_devices(sharing)
    scene, muscles = creature_scene(crawler()), len(crawler().muscles)
    init, step = make_step(scene, TIME_STEP)
    v = SPEED * np.random.default_rng(0).normal(size=(lanes, *scene.mesh.vertices.shape))
    # A wave of muscle lengths of 0.7 to 1 runs along the body.
    phase = 2 * np.pi * (np.arange(steps)[:, None] / 20 - np.arange(muscles) / muscles)
    gait = jnp.asarray(0.85 + 0.15 * np.sin(phase))

    def one(start):
        count = lambda _, info: info.iterations  # noqa: E731
        last, iterations = rollout(partial(step, scene.params), start, gait, observe=count)
        return (last.x - start.x)[:, 0].mean(), iterations

    def work(mesh: Mesh | None) -> Work:
        shared = spread(lambda _, starts: jax.vmap(one)(starts), mesh)
        starts = replicate(jax.vmap(init)(jnp.broadcast_to(scene.params.rest, v.shape), jnp.asarray(v)), mesh)
        run = program(lambda starts: shared(None, starts), mesh).lower(starts).compile()
        iterations = np.asarray(run(starts)[1])
        # In every step all lanes wait for the slowest.
        useful = float(iterations.sum() / (lanes * iterations.max(axis=0).sum()))
        return lambda: (starts,), run, {"useful_iterations_share": useful}

    return compare(f"crawlers/{lanes}", work, lanes * steps, sharing, turns)


def measure_training(optimiser: str, *, samples: int = 4096, sharing: int = 2, turns: int = 5) -> Numbers:
    """Seconds of a step of training a structured DeLaN of two hidden layers on random states of the two-link arm."""
    host_devices(sharing)
    steps, data = TRAININGS[optimiser], uniform(two_link_arm(), samples=samples)
    model = make_delan(two_link_arm().needs, width=8, depth=2, dtype=float)
    parameters = model.init(jax.random.key(0))

    def residual(parameters: Any, q: jax.Array, qd: jax.Array, qdd: jax.Array, tau: jax.Array) -> jax.Array:
        return dynamics(model.energies(parameters)).inverse_dynamics(q, qd, qdd) - tau

    def size(parameters: Any) -> Any:
        return unmonitored(jnp.sum(ravel_pytree(parameters)[0] ** 2))

    problem = Problem(residual, parameters, tuple(map(jnp.asarray, (data.q, data.qd, data.qdd, data.tau))), size)

    def work(mesh: Mesh | None) -> Work:
        shared = sharing_of(problem, mesh)
        if optimiser == "adam":
            stage = descent.stages(problem, Adam(steps=100 * steps, steps_per_dispatch=steps), shared)[0]
        else:
            stage = newton.stages(problem, GaussNewton(steps=steps, steps_per_dispatch=steps), shared)[0]
        fresh = lambda: (replicate(stage.start(None), mesh),)  # noqa: E731
        dispatch = stage.compile(*fresh())
        return fresh, dispatch, {"parameters": ravel_pytree(parameters)[0].size}

    return compare(f"training/{optimiser}", work, steps, sharing, turns)


def compare(case: str, make: Callable[[Mesh | None], Work], steps: int, count: int, turns: int) -> Numbers:
    """Seconds of a step on one and on several devices, medians of turns, and the speed-up."""
    works = {f"{devices}-devices": make(batch_mesh(devices)) for devices in dict.fromkeys((1, count))}
    programs = {name: run for name, (_, run, _) in works.items()}
    seconds = medians_in_turns(programs, {name: make for name, (make, _, _) in works.items()}, repetitions=turns)
    return {
        case: works["1-devices"][2],
        **{
            f"{case}/{name}": {"seconds_per_step": time / steps, "speed_up": seconds["1-devices"] / time}
            for name, time in seconds.items()
        },
    }
