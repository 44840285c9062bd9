"""The same work on one device and on several devices of this process: steps of crawlers, and a training."""

import time
from collections.abc import Callable, Mapping, Sequence
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
from dln_jax.precision import in_float64
from dln_jax.rollout import rollout
from dln_jax.scale.mesh import batch_mesh, program, replicate, spread
from dln_jax.scenes.datasets.generators import uniform
from dln_jax.scenes.pendulums import two_link_arm
from dln_jax.softbody.scene import State
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.creature import TIME_STEP
from scripts.reports.case import Case, Findings
from scripts.reports.rows import Row
from scripts.reports.soft_bodies.gradients import crawling_scene, gait

LANES = (64, 512, 4096)
SPEED = 0.3
"""Standard deviation of the vertices' initial velocities, m/s: crawlers then differ in their iterations."""
TRAININGS = {"adam": 200, "gauss-newton": 5}
"""Steps by optimiser."""


class Work(NamedTuple):
    """A repeatable piece of work."""

    fresh: Callable[[], Any]
    """Creates the argument of `run`; not timed."""
    run: Callable[[Any], Any]
    steps: float
    """Steps in a run."""
    rows: Mapping[str, float] = {}
    """Further quantities."""


def crawlers(mesh: Mesh | None, *, lanes: int, steps: int) -> Work:
    """Steps of a batch of crawlers; all devices receive all distances."""
    scene, muscles = crawling_scene()
    init, step = make_step(scene, TIME_STEP)
    v = SPEED * np.random.default_rng(0).normal(size=(lanes, *scene.mesh.vertices.shape))

    def one(start: State) -> tuple[Array, Array]:
        count = lambda _, info: info.iterations  # noqa: E731
        last, iterations = rollout(partial(step, scene.params), start, gait(steps, muscles), observe=count)
        return (last.x - start.x)[:, 0].mean(), iterations

    shared = spread(lambda _, starts: jax.vmap(one)(starts), mesh)
    starts = replicate(jax.vmap(init)(jnp.broadcast_to(scene.params.rest, v.shape), jnp.asarray(v)), mesh)
    run = program(lambda starts: shared(None, starts), mesh).lower(starts).compile()
    iterations = np.asarray(run(starts)[1])
    # In every step all lanes wait for the slowest.
    useful = float(iterations.sum() / (lanes * iterations.max(axis=0).sum()))
    return Work(lambda: starts, run, lanes * steps, {"useful_iterations_share": useful})


def training(mesh: Mesh | None, *, optimiser: str, samples: int) -> Work:
    """Steps of training a structured DeLaN of two hidden layers on random states of the two-link arm."""
    steps, data = TRAININGS[optimiser], uniform(two_link_arm(), samples=samples)
    model = make_delan(two_link_arm().needs, width=8, depth=2, dtype=float)
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
    fresh = lambda: replicate(stage.start(None), mesh)  # noqa: E731
    dispatch = stage.compile(fresh())
    after, _ = dispatch(fresh())
    return Work(fresh, dispatch, int(after.step), {"parameters": ravel_pytree(parameters)[0].size})


def cases(*, quick: bool = False, lanes: Sequence[int] | None = None, count: int = 2) -> list[Case]:
    """All cases; `lanes` are the numbers of crawlers, and `count` devices share the work."""
    works: dict[str, Callable[[Mesh | None], Work]] = {
        f"crawlers/{number}": partial(crawlers, lanes=number, steps=2 if quick else 10)
        for number in lanes or ((16,) if quick else LANES)
    }
    samples = 1024 if quick else 4096
    works |= {f"training/{name}": partial(training, optimiser=name, samples=samples) for name in TRAININGS}
    turns = 2 if quick else 5
    return [Case(name, in_float64(partial(compared, name, make, count, turns))) for name, make in works.items()]


def compared(case: str, make: Callable[[Mesh | None], Work], count: int, turns: int) -> Findings:
    """Seconds of a step on one and on several devices, medians of turns, and the speed-up."""
    works = {f"{devices}-devices": make(batch_mesh(devices)) for devices in dict.fromkeys((1, count))}
    times = medians(works, turns)
    first = works["1-devices"]
    rows = [Row(f"{case}/{name}", "seconds_per_step", time / works[name].steps, "s") for name, time in times.items()]
    rows += [Row(f"{case}/{name}", "speed_up", times["1-devices"] / time) for name, time in times.items()]
    return Findings(rows + [Row(case, name, float(value)) for name, value in first.rows.items()])


def medians(works: Mapping[str, Work], turns: int) -> dict[str, float]:
    """Median seconds of works that take turns, until their results are ready; the first turn warms up."""
    seconds: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(turns + 1):
        for name, work in works.items():
            start = jax.block_until_ready(work.fresh())
            began = time.perf_counter()
            jax.block_until_ready(work.run(start))
            seconds[name].append(time.perf_counter() - began)
    return {name: float(np.median(values[1:])) for name, values in seconds.items()}
