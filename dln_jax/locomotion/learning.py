"""A policy, and the loop that trains it: update, evaluate, record, until a distance or a number of environment steps.

    command = tanh(W3 tanh(W1 body + W2 clock + b1) + b3)
    change of the actuation = 0.3 tanh((0.625 + 0.375 command - actuation) / 0.3)

Layers start with variances 0.3, 1 and 0.1 over their fan-in: at first the muscles move little. An environment step is
one step of the simulator for one creature. After every call of `improve` the policy is evaluated by one episode from
rest or, if the task varies, by several starts on the steepest slopes that walk for the length of several episodes,
because falls are rare. Steps of evaluations are counted separately. The policy that is kept is the one with the most
successful starts, and among those the one that goes farthest.
"""

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import haiku as hk
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Float

from dln_jax.errors import require_network
from dln_jax.files import finite as finite_values
from dln_jax.learning.engine.checkpoint import has_checkpoint, stored_rows
from dln_jax.locomotion.task import (
    EpisodeState,
    LocomotionTask,
    actuation_seen,
    beginning,
    change_of,
    observe,
    run_episode,
)
from dln_jax.precision import quick_compilation
from dln_jax.process import held_back
from dln_jax.scale import local, program, spread
from dln_jax.types import InputError
from dln_jax.zoo import parameter_files as checkpoints

WIDTH = 64
"""Number of hidden units of the policy."""
VALIDATION = 2_000_000
"""Seed of the starts for selecting a policy; neither training nor `perturbed` draws them."""
VALIDATION_STARTS, VALIDATION_EPISODES = 16, 5
"""Number of starts, and length of their walks in episodes."""
CHECKPOINT = "checkpoint"
"""Prefix of the checkpoint files of a seed."""
LANES = "creatures side by side"
"""Name of the items that devices share, for messages."""

Parameters = Any


class Policy(NamedTuple):
    """Policy as an (init, apply) pair."""

    init: Callable[[Array], Parameters]
    """Random key -> parameters."""
    apply: Callable[[Parameters, Float[Array, " o"]], Float[Array, " k"]]
    """Observation -> change of the actuation."""


GOAL = 5.0
"""The effort of learning is measured up to this distance, in body lengths."""


class Record(NamedTuple):
    """One evaluation."""

    steps: int
    """Environment steps of training so far."""
    seconds: float
    """Wall time so far: compilation, training and evaluation, without interruptions."""
    distance: float
    """Body lengths in one episode, before a fall: from rest, or the mean over several starts."""
    skipped: int
    """Number of updates skipped so far because a step of the simulator did not converge."""
    succeeded: float = 0.0
    """Share of starts that end without a fall and at least a body length ahead."""


def median_to_reach(seeds: Sequence[Sequence[Record]], distance: float, field: str) -> float:
    """Median over seeds of the "steps" or "seconds" to the distance; infinite if at least half never reached it."""
    reached = [
        next((getattr(record, field) for record in records if record.distance >= distance), math.inf)
        for records in seeds
    ]
    return float(np.median(reached))


def rank(record: Record | None) -> tuple[float, float]:
    """Returns the key for comparing evaluations: successful starts, then distance."""
    if record is None or not math.isfinite(record.distance):
        return -math.inf, -math.inf
    return record.succeeded, record.distance


class Learner(NamedTuple):
    """A method of training a policy."""

    policy: Policy
    start: Callable[[int], Any]
    """Seed -> state, a tree of arrays; any object if it is never stored."""
    improve: Callable[[Any], Any]
    """State -> state after some updates; traceable for trees."""
    parameters: Callable[[Any], Parameters]
    """State -> parameters of the policy."""
    steps: int
    """Environment steps per call of `improve`."""
    skipped: Callable[[Any], Any] = lambda state: state.skipped
    """State -> number of skipped updates."""


class CompiledLearner(NamedTuple):
    """A learner with its compiled programs, for any number of seeds."""

    learner: Learner
    improve: Callable[[Any], Any]
    evaluate: Callable[[Parameters], Any]
    seconds: float
    """Compilation time."""
    mesh: Mesh | None = None
    """Devices that run the programs."""


class Learned(NamedTuple):
    """Result of training with one seed."""

    parameters: Parameters
    """Parameters of the best evaluation."""
    records: list[Record]
    compile_seconds: float

    @property
    def selected(self) -> Record | None:
        """The best evaluation; `None` if none is finite."""
        return max((r for r in self.records if math.isfinite(r.distance)), key=rank, default=None)

    @property
    def distance(self) -> float:
        """Distance of the best evaluation, in body lengths."""
        return math.nan if self.selected is None else self.selected.distance


class Goal(NamedTuple):
    """Conditions that end training."""

    steps: int
    """Environment steps; the last update may exceed it."""
    distance: float = math.inf
    """Body lengths."""


def make_policy(task: LocomotionTask, *, width: int = WIDTH) -> Policy:
    """Returns the policy of a task."""
    require_network(width=width, depth=1)

    def network(observation: Float[Array, " o"]) -> Float[Array, " k"]:
        scaled, split = hk.initializers.VarianceScaling, len(observation) - task.clock_size
        hidden = hk.Linear(width, w_init=scaled(0.3), name="body")(observation[:split])
        if task.clock_size:
            hidden += hk.Linear(width, with_bias=False, w_init=scaled(1.0), name="clock")(observation[split:])
        muscles = hk.Linear(task.muscle_count, w_init=scaled(0.1), name="muscles")
        return change_of(actuation_seen(task, observation), jnp.tanh(muscles(jnp.tanh(hidden))))

    transformed = hk.without_apply_rng(hk.transform(network))
    return Policy(lambda key: transformed.init(key, observe(task, beginning(task))), transformed.apply)


def compile_learner(task: LocomotionTask, learner: Learner, mesh: Mesh | None = None) -> CompiledLearner:
    """Compiles a learner's programs, for the mesh that it was built for."""
    began = time.perf_counter()
    state = jax.eval_shape(lambda: learner.start(0))
    improve = program(learner.improve, mesh).lower(state).compile(quick_compilation())
    evaluate = compile_evaluation(task, learner.policy, jax.eval_shape(learner.parameters, state), mesh)
    return CompiledLearner(learner, improve, evaluate, time.perf_counter() - began, mesh)


def compile_evaluation(
    task: LocomotionTask, policy: Policy, parameters: Parameters, mesh: Mesh | None = None
) -> Callable[[Parameters], Any]:
    """Returns parameters -> `distance` and `succeeded` of a `Record`, by an episode from rest or several varied starts.

    A start with a step that does not converge counts 0. Every device walks, and the first device's result counts.
    """
    starts, episodes = (VALIDATION_STARTS, VALIDATION_EPISODES) if any(task.variation) else (1, 1)
    longer = task._replace(episode=episodes * task.episode)

    def evaluated(parameters: Parameters, ones: Float[Array, "1 1"]) -> Float[Array, "1 2"]:
        def walked(start: EpisodeState | None) -> Float[Array, " 2"]:
            walk = run_episode(longer, lambda observation: policy.apply(parameters, observation), start)
            succeeded = (walk.steps >= longer.episode) & (walk.distance >= 1.0)
            return jnp.stack([walk.distance / episodes, succeeded.astype(walk.distance.dtype)])

        if starts == 1:
            return ones * walked(None)
        keys = jax.random.split(jax.random.key(VALIDATION), starts)
        results = jax.vmap(lambda key: walked(beginning(task, key, steepest=True)))(keys)
        return ones * jnp.nan_to_num(results).mean(axis=0)

    # Devices of different models may round differently, but must come to the same decisions.
    evaluate = program(lambda parameters: spread(evaluated, mesh)(parameters, jnp.ones((1, 1)))[0], mesh)
    return evaluate.lower(parameters).compile(quick_compilation())


def evaluation_steps(task: LocomotionTask) -> int:
    """Returns the number of environment steps of one evaluation."""
    return task.episode * (VALIDATION_STARTS * VALIDATION_EPISODES if any(task.variation) else 1)


def learn(
    compiled: CompiledLearner,
    *,
    seed: int,
    goal: Goal,
    directory: Path | None = None,
    settings: dict[str, Any] | None = None,
    resume: bool = False,
    report: Callable[[Record], None] = lambda record: None,
) -> Learned:
    """Trains until the goal; with a directory, stores the state of every evaluation there and can resume bit for bit.

    Args:
        compiled: result of `compile_learner`; without a directory its state may be any object.
        seed: determines everything random.
        directory: an existing folder for checkpoints.
        settings: JSON values that determine the result; a stored run with others is not continued.
        resume: continue the run in the directory, if it has a checkpoint.
        report: called after every evaluation.

    Raises:
        InputError: the stored run had other settings, its files are damaged, or there is no directory to resume from.
        KeyboardInterrupt: raised only after the current evaluation is stored.
    """
    if resume and directory is None:
        raise InputError("resume needs the directory of the run; give it, or start a new run")
    learner, name = compiled.learner, f"{CHECKPOINT}-{seed}"
    identity = {"settings": {**(settings or {}), "seed": seed}}
    state = learner.start(seed)
    best, records = learner.parameters(state), []
    if resume and directory is not None and has_checkpoint(directory, name):
        (state, best), records = _restored(directory, name, identity, (state, best))
    highest = max(map(rank, records), default=rank(None))
    before = records[-1].seconds if records else compiled.seconds
    began = time.perf_counter()
    while not (records and (records[-1].steps >= goal.steps or records[-1].distance >= goal.distance)):
        with held_back():
            state = compiled.improve(state)
            distance, succeeded = map(float, compiled.evaluate(learner.parameters(state)))
            steps = (records[-1].steps if records else 0) + learner.steps
            seconds = before + time.perf_counter() - began
            records.append(Record(steps, seconds, distance, int(learner.skipped(state)), succeeded))
            if rank(records[-1]) > highest:
                highest, best = rank(records[-1]), learner.parameters(state)
            if directory is not None:
                rows = [[value if math.isfinite(value) else None for value in record] for record in records]
                stored = {**identity, "records": rows}
                checkpoints.save_tree(directory, name, (state, best), stored, number=steps)
        report(records[-1])
    return Learned(local(best, compiled.mesh), records, compiled.seconds)


def _restored(directory: Path, name: str, identity: dict[str, Any], like: Any) -> tuple[Any, list[Record]]:
    manifest = checkpoints.load_manifest(directory, name)
    if manifest.get("settings") != finite_values(identity["settings"]):
        raise InputError(f"{directory}: the run was started with other settings; give those it was started with")
    rows = stored_rows(directory / f"{name}.json", manifest, "records", tuple[int, float, float | None, int, float])
    records = [Record(steps, seconds, math.nan if d is None else d, *rest) for steps, seconds, d, *rest in rows]
    return checkpoints.load_tree(directory, name, like), records
