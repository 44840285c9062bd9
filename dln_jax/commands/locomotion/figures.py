"""Figures of a training of a soft creature: the learning against environment steps, and a film of the gait."""

from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

from dln_jax.figures import style
from dln_jax.figures.soft_bodies import write_soft_body_gif
from dln_jax.locomotion.learning import GOAL, Record
from dln_jax.locomotion.task import LocomotionTask, Walk, beginning
from dln_jax.softbody.terms.creature import ground_height

FILMED = 160
"""Steps of the film."""
SHOWN = 3_000_000
"""Seed of the rough ground that is shown."""


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
    write_soft_body_gif(
        path,
        task.creature.mesh,
        x,
        task.dt * np.arange(len(x)),
        muscles=task.creature.muscles,
        ground=ground,
        actuation=np.concatenate([seen.actuation[:1], seen.actuation])[: FILMED + 1],
        title=title,
        stride=2,
        frames_per_second=0.5 / task.dt,
    )
