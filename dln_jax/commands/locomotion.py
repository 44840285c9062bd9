"""Policies of soft creatures: stored ones, their verdict on any ground, and figures of the learning and of the gait."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import msgspec
import numpy as np
from matplotlib.figure import Figure

from dln_jax.figures import style
from dln_jax.figures.soft_bodies import soft_body_drawing
from dln_jax.files import as_type
from dln_jax.locomotion.gradient import Parameters, Policy, make_policy
from dln_jax.locomotion.learning import GOAL, STEPS, Record, Trials
from dln_jax.locomotion.task import LocomotionTask, Walk, beginning, make_task
from dln_jax.locomotion.worlds import Variation
from dln_jax.metrics.verdict import Verdict
from dln_jax.softbody.mesh.shapes import creature_named
from dln_jax.softbody.terms.creature import ground_height
from dln_jax.types import InputError
from dln_jax.zoo.parameter_files import MODEL, REMEDY, load_manifest, load_tree

NAME = "locomotion-gradient"
"""Name of the model in its manifest."""
GOOD, REFUSED = 0.95, 0.5
"""A policy is good from the first share of episodes without a fall on, and refused below the second."""
FILMED, STRIDE = 160, 2
"""Steps of the film, and steps per frame."""
LABELS = {
    "perturbed_starts": "episodes from perturbed starts",
    "perturbed_steps": "steps of an episode",
    "perturbed_without_fall": "episodes without a fall",
    "perturbed_distance_body_lengths": "distance before a fall",
    "distance_body_lengths": "distance",
    "_least": ", least",
    "_rad": "",
}
"""Words for parts of metrics' names."""
UNITS = {"distance_body_lengths": "body lengths", "tilt": "rad"}
SHOWN = 3_000_000
"""Seed of the rough ground that is shown."""


class _Model(msgspec.Struct):
    name: str
    creature: str
    clock_period: float
    variation: dict[str, float]
    settings: dict[str, Any]


def load_policy(folder: str | Path, **variation: float | None) -> tuple[LocomotionTask, Policy, Parameters, int]:
    """Loads the policy of a run of `train_locomotion`: a task of its creature, the policy, parameters and width.

    Args:
        variation: fields of `Variation` for the task, instead of those of the training; `None` for the training's.

    Raises:
        InputError: the folder holds no such policy, its files are damaged, or a field is out of range.
    """
    folder = Path(folder)
    path = folder / f"{MODEL}.json"
    model = as_type(load_manifest(folder, MODEL).get("model"), _Model, name=str(path), remedy=REMEDY)
    if model.name != NAME:
        raise InputError(f"{path} holds '{model.name:.60}'; expected a policy of train_locomotion, '{NAME}'")
    changed = {name: value for name, value in variation.items() if value is not None}
    try:
        creature, trained = creature_named(model.creature), Variation(**model.variation)
        task = make_task(creature, variation=trained, clock_period=model.clock_period)
        policy = make_policy(task, width=model.settings["width"])
    except (InputError, KeyError, TypeError) as error:
        raise InputError(f"{path}: {error}; {REMEDY}") from None
    if changed:
        task = make_task(creature, variation=trained._replace(**changed), clock_period=model.clock_period)
    like = jax.eval_shape(policy.init, jax.random.key(0))
    return task, policy, load_tree(folder, MODEL, like), model.settings["width"]


def judge(trials: Trials, steps: int = STEPS) -> Verdict:
    """Returns the verdict by the share of episodes without a fall; doubtful if one of them ends behind its start."""
    standing, count = trials.standing(steps), len(trials.steps)
    reason = f"{standing.sum()} of {count} episodes of {steps} steps end without a fall"
    if standing.sum() < REFUSED * count:
        return Verdict("refused", reason, "train on this ground")
    if behind := (trials.distance[standing] < 0).sum():
        return Verdict("doubtful", f"{reason}, but {behind} of them end behind their start", "train on this ground")
    if standing.sum() < GOOD * count:
        expected = math.ceil(GOOD * count)
        return Verdict("doubtful", f"{reason}, expected {expected}", "train on this ground, or longer")
    return Verdict("good", reason)


def learning_figure(seeds: Sequence[Sequence[Record]]) -> Figure:
    """Distance of every evaluation against environment steps, with a line per seed."""
    figure, [[axis]] = style.figure(height=3.4)
    for records in seeds:
        steps, distances = [record.steps for record in records], [record.distance for record in records]
        axis.plot(steps, distances, color=style.BLUE, linewidth=1.2, alpha=0.8)
    axis.axhline(GOAL, color="0.6", linewidth=0.8, linestyle="--")
    axis.set(xlabel="environment steps", ylabel="distance in one episode, body lengths")
    style.title(axis, f"gradient, {len(seeds)} seed{'s' if len(seeds) > 1 else ''}")
    return figure


def write_gait(path: Path, task: LocomotionTask, seen: Walk, title: str) -> None:
    """Writes a GIF of the first steps of a walk; in the plane with the ground of the seed `SHOWN`."""
    x = np.concatenate([task.creature.mesh.vertices[None], seen.x])[: FILMED + 1]
    ground, bumps = 0.0, beginning(task, jax.random.key(SHOWN)).world.bumps
    if bumps is not None and x.shape[2] == 2:
        margin = 0.2 * task.length
        along = np.linspace(x[..., 0].min() - margin, x[..., 0].max() + margin, 500)
        ground = np.stack([along, jax.vmap(lambda at: ground_height(bumps, (at,)))(along)], axis=1)
    actuation = np.concatenate([seen.actuation[:1], seen.actuation])[: FILMED + 1]
    creature, t = task.creature, task.dt * np.arange(len(x))
    figure, show = soft_body_drawing(creature.mesh, x, muscles=creature.muscles, actuation=actuation, ground=ground)
    frames = range(0, len(x), STRIDE)
    style.write_gif(path, figure, show, t, frames=frames, frames_per_second=1 / (STRIDE * task.dt), title=title)
