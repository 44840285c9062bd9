"""Work shared by devices in a measurement of scale: steps of crawlers, a training, inverse dynamics of a batch."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh

from dln_jax.learning.engine import descent, newton
from dln_jax.learning.engine.optimisers import Adam, GaussNewton
from dln_jax.learning.engine.problem import Problem, sharing, unmonitored
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.lagrangian import make_delan
from dln_jax.rollout import rollout
from dln_jax.scale.mesh import program, replicate, spread
from dln_jax.scenes.datasets.generators import uniform
from dln_jax.scenes.pendulums import two_link_arm
from dln_jax.softbody.scene import State
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.creature import TIME_STEP
from scripts.reports.soft_bodies.gradients import crawling_scene, gait

SPEED = 0.3
"""Standard deviation of the vertices' initial velocities, m/s: crawlers then differ in their iterations."""


class Work(NamedTuple):
    """A repeatable piece of work."""

    fresh: Callable[[], Any]
    """Creates the argument of `run`; not timed."""
    run: Callable[[Any], Any]
    """The compiled work."""
    facts: dict[str, float] = {}  # noqa: RUF012  never written to
    """Facts about the result."""


def crawlers(mesh: Mesh | None, *, lanes: int, steps: int) -> Work:
    """Steps of a batch of crawlers; all devices receive all distances."""
    scene, muscles = crawling_scene()
    init, step = make_step(scene, TIME_STEP)
    controls = gait(steps, muscles)
    v = SPEED * np.random.default_rng(0).normal(size=(lanes, *scene.mesh.vertices.shape))

    def one(start: State) -> tuple[Array, Array, Array]:
        def seen(_: State, info: Any) -> tuple[Array, Array]:
            return info.iterations, info.converged

        last, (iterations, converged) = rollout(partial(step, scene.params), start, controls, observe=seen)
        return (last.x - start.x)[:, 0].mean(), iterations, converged.all()

    shared = spread(lambda _, starts: jax.vmap(one)(starts), mesh)
    starts = replicate(jax.vmap(init)(jnp.broadcast_to(scene.params.rest, v.shape), jnp.asarray(v)), mesh)
    run = program(lambda starts: shared(None, starts), mesh).lower(starts).compile()
    travelled, iterations, converged = map(np.asarray, run(starts))
    facts = {
        "least_travelled": float(travelled.min()),
        "converged_share": float(converged.mean()),
        # In every step all lanes wait for the slowest.
        "useful_iterations_share": float(iterations.sum() / (lanes * iterations.max(axis=0).sum())),
    }
    return Work(lambda: starts, run, facts)


def training(mesh: Mesh | None, *, optimiser: str, samples: int, steps: int, width: int = 8) -> Work:
    """Steps of training a structured DeLaN of two hidden layers on random states of the two-link arm, in float64."""
    data = uniform(two_link_arm(), samples=samples)
    model = make_delan(two_link_arm().needs, width=width, depth=2, dtype=float)
    parameters = model.init(jax.random.key(0))

    def residual(parameters: Any, q: Array, qd: Array, qdd: Array, tau: Array) -> Array:
        return dynamics(model.energies(parameters)).inverse_dynamics(q, qd, qdd) - tau

    def size(parameters: Any) -> Any:
        return unmonitored(jnp.sum(ravel_pytree(parameters)[0] ** 2))

    arrays = tuple(map(jnp.asarray, (data.q, data.qd, data.qdd, data.tau)))
    problem = Problem(residual, parameters, arrays, size)
    shared = sharing(problem, mesh)
    if optimiser == "adam":
        stage = descent.stages(problem, Adam(steps=100 * steps, steps_per_dispatch=steps), shared)[0]
    else:
        stage = newton.stages(problem, GaussNewton(steps=steps, steps_per_dispatch=steps), shared)[0]

    def fresh() -> Any:
        return replicate(stage.start(None), mesh)

    dispatch = stage.compile(fresh())
    after, _ = dispatch(fresh())
    return Work(fresh, dispatch, {"parameters": ravel_pytree(parameters)[0].size, "steps": int(after.step)})


def inverse_dynamics(mesh: Mesh | None, *, batch: int, dtype: str) -> Work:
    """Torques of a structured DeLaN of two joints and two hidden layers of 64 for a batch of states."""
    model = make_delan(two_link_arm().needs, width=64, depth=2, dtype=dtype)
    keys = jax.random.split(jax.random.key(0), 4)
    energies = model.energies(model.init(keys[0]))
    states = replicate(tuple(jax.random.normal(key, (batch, 2), dtype) for key in keys[1:]), mesh)
    shared = spread(lambda _, states: jax.vmap(dynamics(energies).inverse_dynamics)(*states), mesh)
    run = program(lambda states: shared(None, states), mesh).lower(states).compile()
    return Work(lambda: states, run)


WORK: dict[str, Callable[..., Work]] = {
    "crawlers": crawlers,
    "training": training,
    "inverse-dynamics": inverse_dynamics,
}
"""Works by the names in questions to other processes."""
