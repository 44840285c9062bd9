"""Loop of all learning methods: learn, evaluate, record, until a distance or a number of environment steps.

An environment step is one step of the simulator for one creature. Those of evaluations are counted separately. All
methods are evaluated alike, by one episode from rest, after every call of `improve`.
"""

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jaxtyping import Array

from dln_jax.compilation import quick_compilation
from dln_jax.files import finite as finite_values
from dln_jax.interrupts import held_back
from dln_jax.learning.engine.checkpoint import has_checkpoint, stored_rows
from dln_jax.locomotion.policy import Parameters, Policy
from dln_jax.locomotion.task import Task, run_episode
from dln_jax.scale.mesh import local, program, spread
from dln_jax.types import InputError
from dln_jax.zoo import parameter_files as checkpoints

CHECKPOINT = "checkpoint"
"""Prefix of the checkpoint files of a seed."""
LANES = "creatures side by side"
"""What devices share, for messages."""


class Record(NamedTuple):
    """One evaluation."""

    steps: int
    """Environment steps of learning so far."""
    seconds: float
    """Wall time so far: compilation, learning and evaluation, without interruptions."""
    distance: float
    """Body lengths in one episode from rest."""
    skipped: int
    """Updates skipped so far because a step of the simulator did not converge."""


class Learner(NamedTuple):
    """A learning method."""

    policy: Policy
    start: Callable[[int], Any]
    """Seed -> state, a tree of arrays; of a method that is never stored, any object."""
    improve: Callable[[Any], Any]
    """State -> state after some updates; traceable for trees."""
    parameters: Callable[[Any], Parameters]
    """State -> parameters of the policy."""
    steps: int
    """Environment steps per call of `improve`."""
    skipped: Callable[[Any], Any] = lambda state: state.skipped
    """State -> number of skipped updates."""


class Compiled(NamedTuple):
    """A learner with its compiled programs, for any number of seeds."""

    learner: Learner
    improve: Callable[[Any], Any]
    evaluate: Callable[[Parameters], Any]
    episode: int
    seconds: float
    """Compilation time."""
    mesh: Mesh | None = None
    """Devices that run the programs."""


class Learned(NamedTuple):
    """Result of learning."""

    parameters: Parameters
    """Parameters with the longest distance in an evaluation."""
    records: list[Record]
    compile_seconds: float
    evaluation_steps: int
    """Environment steps of evaluations."""

    @property
    def distance(self) -> float:
        """Longest distance in an evaluation, in body lengths."""
        return max((r.distance for r in self.records if math.isfinite(r.distance)), default=math.nan)


class Goal(NamedTuple):
    """Conditions that end learning."""

    steps: int
    """Environment steps; the last update may exceed it."""
    distance: float = math.inf
    """Body lengths."""


Report = Callable[[Record], None]


def compile_learner(task: Task, learner: Learner, mesh: Mesh | None = None) -> Compiled:
    """Compiles a learner's programs, for the mesh that it was built for."""
    began = time.perf_counter()
    state = jax.eval_shape(lambda: learner.start(0))
    improve = program(learner.improve, mesh).lower(state).compile(quick_compilation())
    evaluate = compile_evaluation(task, learner.policy, jax.eval_shape(learner.parameters, state), mesh)
    return Compiled(learner, improve, evaluate, task.episode, time.perf_counter() - began, mesh)


def compile_evaluation(
    task: Task, policy: Policy, parameters: Parameters, mesh: Mesh | None = None
) -> Callable[[Parameters], Any]:
    """Parameters -> body lengths in one episode from rest; every device walks, and the first device's result counts."""

    def judged(parameters: Parameters, ones: Array) -> Array:
        return ones * run_episode(task, lambda seen: policy.apply(parameters, seen)).distance

    # Devices of different models may round differently, and must come to the same decisions.
    judge = program(lambda parameters: spread(judged, mesh)(parameters, jnp.ones(1))[0], mesh)
    return judge.lower(parameters).compile(quick_compilation())


def learn(
    compiled: Compiled,
    *,
    seed: int,
    goal: Goal,
    directory: Path | None = None,
    settings: dict[str, Any] | None = None,
    resume: bool = False,
    report: Report = lambda record: None,
) -> Learned:
    """Learns until the goal; with a directory, stores the state of every evaluation there and can resume bit for bit.

    Args:
        compiled: from `compile_learner`; without a directory its state may be any object.
        seed: decides everything random.
        goal: conditions that end learning.
        directory: an existing folder for checkpoints.
        settings: JSON values that decide the result; a stored run with others is not continued.
        resume: continue the run in the directory, if it has a checkpoint.
        report: called after every evaluation.

    Raises:
        InputError: the stored run had other settings, or its files are damaged.
        KeyboardInterrupt: raised only after the current evaluation is stored.
    """
    learner, name = compiled.learner, f"{CHECKPOINT}-{seed}"
    identity = {"settings": {**(settings or {}), "seed": seed}}
    state = learner.start(seed)
    best, records = learner.parameters(state), []
    if resume and directory is not None and has_checkpoint(directory, name):
        (state, best), records = _restored(directory, name, identity, (state, best))
    farthest = max((record.distance for record in records), default=-math.inf)
    before = records[-1].seconds if records else compiled.seconds
    began = time.perf_counter()
    while not reached(records, goal):
        with held_back():
            state = compiled.improve(state)
            distance = float(compiled.evaluate(learner.parameters(state)))
            if distance > farthest:
                farthest, best = distance, learner.parameters(state)
            steps = (records[-1].steps if records else 0) + learner.steps
            seconds = before + time.perf_counter() - began
            records.append(Record(steps, seconds, distance, int(learner.skipped(state))))
            if directory is not None:
                rows = [[value if math.isfinite(value) else None for value in record] for record in records]
                stored = {**identity, "records": rows}
                checkpoints.save_tree(directory, name, (state, best), stored, number=steps)
        report(records[-1])
    return Learned(local(best, compiled.mesh), records, compiled.seconds, len(records) * compiled.episode)


def finite(tree: Any) -> Any:
    """Whether all numbers of a tree are finite."""
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(tree)]).all()


def chosen(condition: Any, new: Any, old: Any) -> Any:
    """Selects one of two trees."""
    return jax.tree.map(lambda new, old: jnp.where(condition, new, old), new, old)


def reached(records: list[Record], goal: Goal) -> bool:
    """Whether the last evaluation meets the goal."""
    return bool(records) and (records[-1].steps >= goal.steps or records[-1].distance >= goal.distance)


def _restored(directory: Path, name: str, identity: dict[str, Any], like: Any) -> tuple[Any, list[Record]]:
    manifest = checkpoints.load_manifest(directory, name)
    if manifest.get("settings") != finite_values(identity["settings"]):
        raise InputError(f"{directory}: the run was started with other settings; give those it was started with")
    rows = stored_rows(directory / f"{name}.json", manifest, "records", tuple[int, float, float | None, int])
    records = [Record(steps, seconds, math.nan if d is None else d, n) for steps, seconds, d, n in rows]
    return checkpoints.load_tree(directory, name, like), records
