"""Measure what several devices of one process gain over one device.

Crawlers are soft bodies stepped side by side; training is that of a small network. One device and several take turns;
compilation is apart, results are waited for, medians count.
"""

from collections.abc import Mapping
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from dln_jax import Adam, GaussNewton, fit
from dln_jax.data.splits import Split, select
from dln_jax.learning.dynamics import problem
from dln_jax.models.model import make_delan
from dln_jax.rollout import rollout
from dln_jax.scale import batch_mesh, host_devices, program, replicate, spread
from dln_jax.scenes.datasets.generators import uniform
from dln_jax.scenes.pendulums import two_link_arm
from dln_jax.softbody.examples import creature_scene
from dln_jax.softbody.mesh.shapes import crawler
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.creature import TIME_STEP
from scripts.reports.run import Case, Numbers
from scripts.reports.timing import medians_in_turns

SPEED = 0.3
"""Standard deviation of the vertices' initial velocities, m/s: crawlers then differ in their iterations."""
HELD_OUT = 16
"""Samples of training that select among iterates, which every device evaluates."""
TRAININGS = {
    "adam": Adam(steps=200, steps_per_dispatch=200),
    "gauss-newton": GaussNewton(steps=5, steps_per_dispatch=5),
}


def measure_crawlers(*, lanes: int = 64, steps: int = 10, sharing: int = 2, turns: int = 5) -> Numbers:
    """Seconds of a step of one of many soft crawlers, stepped side by side.

    Args:
        lanes: crawlers side by side.
        sharing: devices that share them.
    """
    meshes = meshes_of(sharing)
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

    programs, starts = {}, {}
    for name, mesh in meshes.items():
        shared = spread(lambda _, starts: jax.vmap(one)(starts), mesh)
        start = replicate(jax.vmap(init)(jnp.broadcast_to(scene.params.rest, v.shape), jnp.asarray(v)), mesh)
        programs[name] = program(partial(shared, None), mesh).lower(start).compile()
        starts[name] = partial(tuple, [start])
    iterations = np.asarray(programs["1-devices"](*starts["1-devices"]())[1])
    # In every step all lanes wait for the slowest.
    useful = iterations.sum() / (lanes * iterations.max(axis=0).sum())
    seconds = medians_in_turns(programs, starts, repetitions=turns)
    case = f"crawlers/{lanes}"
    return {case: {"useful_iterations_share": useful}, **speed_ups(case, seconds, lanes * steps)}


def measure_training(optimiser: str, *, samples: int = 4096, sharing: int = 2, turns: int = 5) -> Numbers:
    """Seconds of a step of training a structured DeLaN of two hidden layers on random states of the two-link arm."""
    meshes, needs = meshes_of(sharing), two_link_arm().needs
    data = uniform(two_link_arm(), samples=samples + 2 * HELD_OUT)
    places = (range(samples), range(samples, samples + HELD_OUT), range(samples + HELD_OUT, len(data.t)))
    task = problem(make_delan(needs, width=8, depth=2, dtype=float), Split(*(select(data, place) for place in places)))
    settings, seconds = TRAININGS[optimiser], {name: [] for name in meshes}
    for _ in range(turns):
        for name, mesh in meshes.items():
            seconds[name].append(fit(task, settings, mesh=mesh).train_seconds)
    medians = {name: float(np.median(values)) for name, values in seconds.items()}
    return speed_ups(f"training/{optimiser}", medians, settings.steps)


def meshes_of(sharing: int) -> dict[str, Mesh | None]:
    """One device, and those that share the work."""
    host_devices(sharing)
    return {f"{count}-devices": batch_mesh(count) for count in dict.fromkeys((1, sharing))}


def speed_ups(case: str, seconds: Mapping[str, float], steps: int) -> Numbers:
    """Seconds of a step on one and on several devices, and the speed-up."""
    return {
        f"{case}/{name}": {"seconds_per_step": time / steps, "speed_up": seconds["1-devices"] / time}
        for name, time in seconds.items()
    }


CASES = (
    *(
        Case(f"crawlers/{lanes}", measure_crawlers, {"lanes": lanes}, quick={"steps": 2, "turns": 2})
        for lanes in (64, 512, 4096)
    ),
    *(
        Case(f"training/{name}", partial(measure_training, name), quick={"samples": 1024, "turns": 2})
        for name in TRAININGS
    ),
)
