"""Training loop for policies: update, evaluate, record, up to a distance or a number of environment steps.

An environment step is one step of the simulator for one creature. After some updates the policy is evaluated in one
episode from rest. If the task varies, it is evaluated from several starts on the steepest slopes, each for several
episodes, because falls are rare. Steps of evaluations are counted separately. The best policy has the most successful
starts, and among equals the longest distance.
"""

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int

from dln_jax.files import finite as finite_values
from dln_jax.learning.engine.checkpoint import has_checkpoint, stored_rows
from dln_jax.locomotion.gradient import GradientSettings, GradientState, Parameters, Policy, make_policy, make_updates
from dln_jax.locomotion.task import EpisodeState, LocomotionTask, beginning, run_episode
from dln_jax.precision import quick_compilation
from dln_jax.process import held_back
from dln_jax.scale import local, program, spread
from dln_jax.types import InputError
from dln_jax.zoo import parameter_files as checkpoints

VALIDATION = 2_000_000
"""Seed of the starts for selecting a policy; neither training nor `perturbed_trials` draws them."""
VALIDATION_STARTS, VALIDATION_EPISODES = 16, 5
"""Number of starts, and length of each walk in episodes."""
STARTS, STEPS = 100, 2000
"""Number of episodes, and steps per episode, for judging a policy."""
AT_ONCE = 25
"""Number of these episodes side by side."""
SEED = 1_000_000
"""Seed of their starts, which training does not draw."""
CHECKPOINT = "checkpoint"
"""Prefix of the checkpoint files of a seed."""
GOAL = 5.0
"""Distance, in body lengths, up to which the learning effort is measured."""


class Record(NamedTuple):
    """One evaluation."""

    steps: int
    """Environment steps of training so far."""
    seconds: float
    """Wall time so far: compilation, training and evaluation, without interruptions."""
    distance: float
    """Body lengths in one episode, before a fall: from rest, or the mean over several starts."""
    skipped: int
    """Number of skipped updates so far, because a simulator step did not converge."""
    succeeded: float = 0.0
    """Share of starts without a fall and with at least a body length of progress."""


class Learner(NamedTuple):
    """Compiled programs that train a policy, for any number of seeds."""

    start: Callable[[int], GradientState]
    """Seed -> state."""
    improve: Callable[[GradientState], GradientState]
    """State -> state after some updates."""
    evaluate: Callable[[Parameters], Any]
    """Parameters -> `distance` and `succeeded` of a `Record`."""
    steps: int
    """Environment steps per call of `improve`."""
    seconds: float
    """Compilation time."""
    mesh: Mesh | None
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


def rank(record: Record | None) -> tuple[float, float]:
    """Returns the key for comparing evaluations: successful starts, then distance."""
    if record is None or not math.isfinite(record.distance):
        return -math.inf, -math.inf
    return record.succeeded, record.distance


def median_to_reach(seeds: Sequence[Sequence[Record]], distance: float, field: str) -> float:
    """Returns the median over seeds of the "steps" or "seconds" to the distance; infinite if at least half never reach
    it."""
    reached = [
        next((getattr(record, field) for record in records if record.distance >= distance), math.inf)
        for records in seeds
    ]
    return float(np.median(reached))


def train(
    task: LocomotionTask,
    *,
    seeds: Sequence[int],
    steps: int,
    until: float = math.inf,
    settings: GradientSettings = GradientSettings(),  # noqa: B008
    initial: Parameters | None = None,
    directory: Path | None = None,
    resume: bool = False,
    mesh: Mesh | None = None,
    report: Callable[[int, Record], None] = lambda seed, record: None,
) -> list[Learned]:
    """Trains with several seeds, one after the other; programs are compiled once.

    Args:
        steps: environment steps of a seed; the last update may exceed them.
        until: distance in body lengths at which the training of a seed ends.
        initial: parameters of a policy of this width to train further (default: random).
        directory: folder for stored states.
        resume: continue the stored runs.
        mesh: devices that share the creatures simulated side by side.
        report: called with seed and record after every evaluation.

    Raises:
        InputError: settings are out of range or differ from the stored run, or the mesh does not divide the creatures.
    """
    policy = make_policy(task, width=settings.width)
    if initial is not None:
        policy = policy._replace(init=lambda _: initial)
    learner = make_learner(task, policy, settings, steps=steps, mesh=mesh)
    facts = {"creature": task.creature.name, "episode": task.episode, "steps": steps}
    facts |= {"upright": task.upright, "speed": task.speed, "clock_period": task.clock_period}
    facts |= {**task.variation._asdict(), **settings._asdict()}
    one = partial(learn, learner, steps=steps, until=until, directory=directory, settings=facts, resume=resume)
    return [one(seed=seed, report=partial(report, seed)) for seed in seeds]


def make_learner(
    task: LocomotionTask,
    policy: Policy,
    settings: GradientSettings = GradientSettings(),  # noqa: B008
    *,
    steps: int,
    mesh: Mesh | None = None,
) -> Learner:
    """Compiles the programs that train a policy for `steps` environment steps; errors as for `make_updates`."""
    start, improve = make_updates(task, policy, settings, steps=steps, mesh=mesh)
    began = time.perf_counter()
    state = jax.eval_shape(lambda: start(0))
    improved = program(improve, mesh).lower(state).compile(quick_compilation())
    starts, episodes = (VALIDATION_STARTS, VALIDATION_EPISODES) if any(task.variation) else (1, 1)
    longer = task._replace(episode=episodes * task.episode)

    def evaluated(parameters: Parameters, ones: Float[Array, "1 1"]) -> Float[Array, "1 2"]:
        def walked(start: EpisodeState | None) -> Float[Array, " 2"]:
            distance, standing = run_episode(longer, partial(policy.apply, parameters), start)
            succeeded = (standing >= longer.episode) & (distance >= 1.0)
            return jnp.stack([distance / episodes, succeeded.astype(distance.dtype)])

        if starts == 1:
            return ones * walked(None)
        keys = jax.random.split(jax.random.key(VALIDATION), starts)
        results = jax.vmap(lambda key: walked(beginning(task, key, steepest=True)))(keys)
        # A start with a step that does not converge counts 0.
        return ones * jnp.nan_to_num(results).mean(axis=0)

    # Every device walks, and the result of the first counts: different devices may round differently, but must make the
    # same decisions.
    evaluate = program(lambda parameters: spread(evaluated, mesh)(parameters, jnp.ones((1, 1)))[0], mesh)
    evaluate = evaluate.lower(state.averaged).compile(quick_compilation())
    in_one = settings.updates_of(task) * settings.lanes * settings.window
    return Learner(start, improved, evaluate, in_one, time.perf_counter() - began, mesh)


def evaluation_steps(task: LocomotionTask) -> int:
    """Returns the number of environment steps of one evaluation."""
    return task.episode * (VALIDATION_STARTS * VALIDATION_EPISODES if any(task.variation) else 1)


def learn(
    learner: Learner,
    *,
    seed: int,
    steps: int,
    until: float = math.inf,
    directory: Path | None = None,
    settings: dict[str, Any] | None = None,
    resume: bool = False,
    report: Callable[[Record], None] = lambda record: None,
) -> Learned:
    """Trains up to the goal. With a directory, it stores the state of every evaluation; resuming is exact.

    Args:
        seed: determines everything random.
        steps, until: as in `train`.
        directory: an existing folder for checkpoints.
        settings: JSON values that determine the result; a stored run with other settings is not continued.
        resume: continue the run in the directory, if it has a checkpoint.
        report: called after every evaluation.

    Raises:
        InputError: the stored run had other settings, its files are damaged, or there is no directory to resume from.
        KeyboardInterrupt: raised only after the current evaluation is stored.
    """
    if resume and directory is None:
        raise InputError("resume needs the directory of the run; pass it, or start a new run")
    name, identity = f"{CHECKPOINT}-{seed}", {"settings": {**(settings or {}), "seed": seed}}
    state = learner.start(seed)
    best, records = state.averaged, []
    if resume and directory is not None and has_checkpoint(directory, name):
        manifest = checkpoints.load_manifest(directory, name)
        if manifest.get("settings") != finite_values(identity["settings"]):
            raise InputError(f"{directory}: the run has other settings; resume it with its own settings")
        rows = stored_rows(directory / f"{name}.json", manifest, "records", tuple[int, float, float | None, int, float])
        records = [Record(done, seconds, math.nan if d is None else d, *rest) for done, seconds, d, *rest in rows]
        state, best = checkpoints.load_tree(directory, name, (state, best))
    highest = max(map(rank, records), default=rank(None))
    before = records[-1].seconds if records else learner.seconds
    began = time.perf_counter()
    while not (records and (records[-1].steps >= steps or records[-1].distance >= until)):
        with held_back():
            state = learner.improve(state)
            distance, succeeded = map(float, learner.evaluate(state.averaged))
            done = (records[-1].steps if records else 0) + learner.steps
            seconds = before + time.perf_counter() - began
            records.append(Record(done, seconds, distance, int(state.skipped), succeeded))
            if rank(records[-1]) > highest:
                highest, best = rank(records[-1]), state.averaged
            if directory is not None:
                rows = [[value if math.isfinite(value) else None for value in record] for record in records]
                stored = {**identity, "records": rows}
                checkpoints.save_tree(directory, name, (state, best), stored, number=done)
        report(records[-1])
    return Learned(local(best, learner.mesh), records, learner.seconds)


class Trials(NamedTuple):
    """Results of n episodes from perturbed starts."""

    distance: Float[np.ndarray, " n"]
    """Body lengths before a fall; NaN if a step did not converge."""
    steps: Int[np.ndarray, " n"]
    """Steps before a fall, or all."""
    ahead: Float[np.ndarray, " n"]
    """Gravity along x, in m/s²: positive downhill, negative uphill, 0 on level ground."""

    def standing(self, steps: int) -> Bool[np.ndarray, " n"]:
        """Returns the mask of episodes of this length without a fall."""
        return np.isfinite(self.distance) & (self.steps >= steps)


def perturbed_trials(
    task: LocomotionTask,
    policy: Policy,
    parameters: Parameters,
    *,
    starts: int = STARTS,
    steps: int = STEPS,
    seed: int = SEED,
) -> Trials:
    """Runs episodes from random starts of the task's variation, on its steepest slopes."""
    task = task._replace(episode=steps)

    def trial(parameters: Parameters, key: Array):
        start = beginning(task, key, steepest=True)
        episode = run_episode(task, partial(policy.apply, parameters), start)
        return *episode, jnp.asarray(0.0) if start.world.gravity is None else start.world.gravity[0]

    keys = jax.random.split(jax.random.key(seed), starts)
    trials = jax.jit(lambda parameters: jax.lax.map(partial(trial, parameters), keys, batch_size=AT_ONCE))
    return Trials(*map(np.asarray, trials(parameters)))


def numbers_of(trials: Trials, steps: int = STEPS) -> dict[str, float]:
    """Returns metrics: number of episodes, number without a fall, and median and worst distance.

    On slopes it adds the numbers without a fall and the distances downhill and uphill.
    """
    standing = trials.standing(steps)
    numbers = {"perturbed_starts": float(len(standing)), "perturbed_steps": float(steps)}
    groups = {"": np.ones_like(standing), "_downhill": trials.ahead > 0, "_uphill": trials.ahead < 0}
    for name, group in groups.items():
        if not group.any():
            continue
        finite = trials.distance[group & np.isfinite(trials.distance)]
        if name:
            numbers[f"perturbed_starts{name}"] = float(group.sum())
        numbers[f"perturbed_without_fall{name}"] = float(standing[group].sum())
        if len(finite):
            numbers[f"perturbed_distance_body_lengths_median{name}"] = float(np.median(finite))
            numbers[f"perturbed_distance_body_lengths_least{name}"] = float(finite.min())
    return numbers
