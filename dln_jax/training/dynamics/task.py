"""A task of dynamics: the data, their `Needs`, the model and its training."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from jax.sharding import Mesh

from dln_jax.data.splits import Split
from dln_jax.learning.engine.optimisers import Optimiser
from dln_jax.learning.engine.problem import Problem, Training
from dln_jax.learning.gauges import summed_with_friction, without_offset
from dln_jax.learning.kinematics.fit import TreeFit
from dln_jax.learning.objectives import SCALED_TORQUE, TORQUE, Objective, objective_of
from dln_jax.models.model import Parameters
from dln_jax.scenes.scene import Scene
from dln_jax.time_limit import seconds_left
from dln_jax.training.dynamics.options import AUTO, FITS, NetworkOptions
from dln_jax.training.dynamics.recorded import Recorded
from dln_jax.types import Needs
from dln_jax.zoo.descriptions import build


class Solver(NamedTuple):
    """How an optimiser trains a model."""

    optimiser: Optimiser
    reason: str
    """Reason for this optimiser; empty if the user chose it."""
    problem: Problem
    samples: int | None
    """Number of training samples that are drawn for it; `None` for all."""


class Refinement(NamedTuple):
    """A learned tree whose bodies and friction were fitted to motions, if these predict validation motions longer."""

    parameters: Parameters
    kept: bool
    validation: tuple[float, float]
    """Mean valid prediction times of the parameters by torques and by motions, s."""
    test: tuple[float, float]

    @property
    def line(self) -> str:
        """Summary of the refinement."""
        shown = "; ".join(
            f"{name} motions predicted for {after:.3g} s, by torques for {before:.3g} s"
            for name, (before, after) in (("validation", self.validation), ("test", self.test))
        )
        return f"refined by motions: {shown}; {'kept' if self.kept else 'not kept, as validation motions decide'}"

    @property
    def metrics(self) -> dict[str, float | int]:
        """Entries of metrics.json."""
        (before, after), kept = self.test, int(self.kept)
        return {"by_torques_vpt_seconds": before, "by_motions_vpt_seconds": after, "refinement_kept": kept}


class Task(NamedTuple):
    """A resolved task: the data, their `Needs`, and the model to train."""

    recorded: Recorded
    kind: str
    description: dict[str, Any]
    """Description of the model, for `dln_jax.zoo.build`."""
    objective: Objective
    solver: Solver | None
    """`None` for models that are fitted without an optimiser."""
    seeds: int | tuple[int, ...]
    """One seed, or several that train in one program."""
    until: float
    """Reading of `time.perf_counter` at which training stops, for the command or a candidate of model selection."""
    search: TreeFit | None = None
    """Outcome of the search for the joint frames of a learned tree."""
    refinement: Refinement | None = None
    """Its refinement by motions, if it was asked for."""
    best: int | None = None
    """Index of the seed selected by cross-validation; `None` without cross-validation."""

    @property
    def seconds(self) -> float:
        """Seconds left for fits."""
        return seconds_left(self.until)

    @property
    def name(self) -> str:
        """Name of the data."""
        return self.recorded.name

    @property
    def sets(self) -> Split:
        """Training, validation and test data."""
        return self.recorded.sets

    @property
    def scene(self) -> Scene | None:
        """Scene of the data, if known."""
        return self.recorded.scene

    @property
    def needs(self) -> Needs:
        """`Needs` of the plant."""
        return self.recorded.needs

    @property
    def summed(self) -> list[int]:
        """Joints, counted from 1, whose gravity and friction are known only in sum."""
        return summed_with_friction(self.needs, self.sets.train, network=self.solver is not None)

    @property
    def precision(self) -> str:
        """f32 or f64, for the model and its training."""
        return self.description["precision"]


class Method(NamedTuple):
    """A way of fitting: the `METHOD` of a module in `methods`."""

    plan: Callable[[Any, str, Recorded, Objective], tuple[dict[str, Any], Solver | None]]
    """(options, model, data, objective) -> description of the model, and its solver if it has one; refuses options that
    contradict the data with an `InputError`."""
    fit: Callable[[Task, Any, Path, Mesh | None], tuple[Task, Training]]
    """(task, options, run folder, devices) -> the fit, and the task with the description that the fit has chosen."""


def method_of(kind: str) -> Method:
    """Returns the way of fitting a model."""
    return FITS[kind].method()


def planned(options: Any, kind: str, recorded: Recorded, until: float) -> Task:
    """Plans the task of a model, which ends when `time.perf_counter` reads `until`; nothing is written yet.

    A network's friction has no offset if its potential represents one.

    Raises:
        InputError: data that the model cannot be fitted to.
    """
    needs = recorded.needs
    if NetworkOptions in FITS[kind].options and summed_with_friction(needs, recorded.sets.train, network=True):
        lines = (*recorded.lines, "friction has no offset: the potential takes any constant")
        recorded = recorded._replace(needs=without_offset(needs), lines=lines)
    asked = getattr(options, "objective", None)
    objective = SCALED_TORQUE if kind == AUTO else objective_of(kind, recorded.sets.train, asked)
    if objective is TORQUE and getattr(options, "target", None) is None:
        objective = SCALED_TORQUE
    description, solver = method_of(kind).plan(options, kind, recorded, objective)
    if description:
        build(description)  # refuses descriptions without a model
    return Task(recorded, kind, description, objective, solver, seeds_of(options), until)


def seeds_of(options: Any) -> int | tuple[int, ...]:
    """The seed of the options, or all of them if several are trained in one program."""
    seeds = getattr(options, "seeds", 1)
    return options.seed if seeds == 1 else tuple(range(options.seed, options.seed + seeds))
