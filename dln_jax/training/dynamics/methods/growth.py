"""--target: trains structured networks of growing size until one is accurate enough, and keeps the fastest of those."""

import itertools
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from rich.console import Console
from rich.table import Table

from dln_jax.files import write_json
from dln_jax.learning.dynamics import identity_of, problem
from dln_jax.learning.engine.checkpoint import Checkpoint
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import Optimiser
from dln_jax.learning.engine.problem import Training
from dln_jax.mechanics.equations import dynamics
from dln_jax.precision import data_type
from dln_jax.scale.mesh import of_first_process
from dln_jax.time_limit import SOON
from dln_jax.training.dynamics.results import latency_of
from dln_jax.training.dynamics.task import Task
from dln_jax.zoo.descriptions import build
from dln_jax.zoo.run import compiled

WIDTHS = (4, 8, 16, 32)
DEPTHS = (1, 2)


class Candidate(NamedTuple):
    """A trained network with its error and speed."""

    width: int
    depth: int
    networks: int
    """1 if factor and potential share a network, else 2."""
    parameters: int
    validation_error: float
    train_seconds: float
    """Includes compilation."""
    one_step_us: float

    @property
    def name(self) -> str:
        """Name for tables and messages."""
        return f"{self.depth} x {self.width}, {'one network' if self.networks == 1 else 'two networks'}"


def grow_to_target(
    task: Task, optimiser: Optimiser, target: float, folder: Path, *, resume: bool, mesh: Mesh | None
) -> tuple[Task, Training]:
    """Trains all candidates of a width before the next width, and stops at the first width that meets the target.

    Keeps the fastest candidate that meets it or, if none does, the most accurate. Writes `candidates.json` and a table.
    """
    tried: list[tuple[Candidate, Task, Training]] = []
    enough: list[tuple[Candidate, Task, Training]] = []
    kinds = list(itertools.product(DEPTHS, (True, False) if task.needs.gravity else (False,)))
    ended = ""
    for width in WIDTHS:
        for depth, shared in kinds:
            if tried and of_first_process(task.seconds <= SOON, mesh):
                ended = f"out of time: networks of width {width} and more were not all tried"
                break
            description = {**task.description, "width": width, "depth": depth, "shared_trunk": shared}
            tried.append(_try(task._replace(description=description), optimiser, folder, resume=resume, mesh=mesh))
            candidate = tried[-1][0]
            met = candidate.validation_error <= target
            enough += tried[-1:] * met
            verdict = "met" if met else "not met"
            print(f"{candidate.name}: validation {candidate.validation_error:.2e}, target {verdict}")
        if enough or ended:
            break
    if ended:
        print(ended)
    fastest = min(enough, key=lambda trial: trial[0].one_step_us, default=None)
    chosen = fastest or min(tried, key=lambda trial: trial[0].validation_error)
    write_json(folder / "candidates.json", {"candidates": [candidate._asdict() for candidate, *_ in tried]})
    columns = ("network", "parameters", "validation error", "training, s", "one step, µs", "")
    table = Table(*columns, title=f"grown until the validation error is {target:g}")
    for candidate, *_ in tried:
        numbers = f"{candidate.parameters:,}", f"{candidate.validation_error:.2e}", f"{candidate.train_seconds:.1f}"
        verdict = "kept" if candidate == chosen[0] else "met" if candidate.validation_error <= target else ""
        table.add_row(candidate.name, *numbers, f"{candidate.one_step_us:.1f}", verdict)
    Console(highlight=False, soft_wrap=True).print(table)
    if fastest is None:
        print(f"no candidate meets {target:g}; kept is the most accurate. More --steps or --seconds may help")
    return chosen[1], chosen[2]


def _try(
    task: Task, optimiser: Optimiser, folder: Path, *, resume: bool, mesh: Mesh | None
) -> tuple[Candidate, Task, Training]:
    model, wanted = build(task.description), task.description
    networks = 1 if wanted["shared_trunk"] else 2
    name = f"checkpoint_{wanted['width']}x{wanted['depth']}_{networks}"
    identity = identity_of(optimiser, task.sets, task.objective, seeds=task.seeds)
    training = fit(
        problem(model, task.sets, task.objective, seeds=task.seeds),
        optimiser,
        checkpoint=Checkpoint(folder, identity, resume, name),
        seconds=task.seconds,
        mesh=mesh,
    )
    system = compiled(dynamics(model.energies(training.parameters)), data_type(task.precision))
    candidate = Candidate(
        width=wanted["width"],
        depth=wanted["depth"],
        networks=networks,
        parameters=sum(jnp.size(leaf) for leaf in jax.tree.leaves(training.parameters)),
        validation_error=float(training.validation),
        train_seconds=training.train_seconds + training.compile_seconds,
        # The selection depends on it, so all processes must use the same value.
        one_step_us=of_first_process(latency_of(system, task, calls=2000).p50_us, mesh),
    )
    return candidate, task, training
