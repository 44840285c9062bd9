"""Learning a plant for its swing-up: any plant by exploring, identifying and tuning, and the desktop plants' models."""

import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control.closed_loop import ClosedLoopRun, Controller, Hardware, Push, simulate
from dln_jax.control.desktop_plants import SECONDS, DesktopPlant, model_of_plant, nominal_model, simulated_plant
from dln_jax.control.estimate.tuning import from_log
from dln_jax.control.plants.estimators import estimator_of, require_estimator
from dln_jax.control.plants.exploring import Exploration, Explored, explore
from dln_jax.control.plants.plant import Plant
from dln_jax.control.plants.runs import PlantRun, Trials, compiled, judged_runs, run, start_of
from dln_jax.control.plants.tuning import Tuned, tune
from dln_jax.control.state_space import field_of
from dln_jax.data.encoders.sampling import held_at_equal_steps, noise_of
from dln_jax.data.schema import Trajectories
from dln_jax.learning.engine.problem import ProgressReport, silent
from dln_jax.learning.recordings import FittedPlant, PreparedRecording, identified, identified_chain, learned, prepare
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.types import InputError

CUTOFFS = (1.0, 2.0)
"""Multiples of the usual cut-off that are compared: fast motions of a short log may be too rare to raise it."""
BAND = 10.0
"""Factor that widens the filter's torque band, for model errors that a short log does not show."""
MODELS = ("delan", "identified", "analytic", "known")
"""A learned network; a fit linear in its parameters; nominal dimensions without friction; the plant itself."""
TEST_SEED = 500
"""Offset of the seed for test motions."""


class Learned(NamedTuple):
    """A plant's model and law, and the recording that they come from."""

    prepared: PreparedRecording
    fitted: FittedPlant
    tuned: Tuned
    seconds: float
    """Time for all steps, s."""


def learn_to_swing_up(
    plant: Plant,
    exploration: Exploration = Exploration(),  # noqa: B008
    *,
    estimator: str = "extended",
    seed: int = 0,
    recover: str = "swing-up",
    say: Callable[[str], None] = lambda _: None,
    keep: Callable[[Explored], None] = lambda _: None,
) -> Learned:
    """Explores a plant, learns its model and tunes its law.

    Args:
        plant: plant to swing up; exploration guards it.
        estimator: one of `plants.ESTIMATORS`, for the law's states.
        seed: seed of the noise and of the trials.
        recover: as for `tune`.
        say: called with a line of text after every step.
        keep: called after the exploration, to store a recording that a later step might refuse.

    Raises:
        InputError: as for `explore`, `prepare`, `identified_chain`, `from_log` and `tune`, or an unknown estimator.
    """
    require_estimator(estimator)
    began = time.perf_counter()
    explored = explore(plant, model_of, exploration, seed=seed)
    recording = explored.recording
    say(
        f"explored: {len(recording.t) / plant.layout.rate:.3g} s in {len(recording.label)} episodes, "
        f"{len(explored.stopped)} stopped"
    )
    keep(explored)
    recording = held_at_equal_steps(recording, plant.layout.rate)
    prepared = prepare(recording, chain=True, cutoffs=CUTOFFS)
    fitted = identified_chain(prepared, plant.layout.needs)
    noise = np.asarray(noise_of(recording.q, recording.trajectory), float)
    B = plant.layout.actuation
    process = from_log(fitted.dynamics, recording, actuation=B, delay=prepared.delay)
    band = np.asarray(process.disturbance)
    # What the model does not explain of the driven joints acts as noise of the motors in the trials.
    hardware = Hardware(encoder_noise=noise, control_noise=np.linalg.pinv(B) @ band, delay=int(prepared.delay))
    unexplained = np.max(np.atleast_1d(hardware.control_noise) / (np.ptp(plant.layout.limits.control, axis=1) / 2))
    say(
        f"learned: controls {prepared.delay:.3g} sample(s) late, q filtered at {prepared.cutoff:.3g} Hz, "
        f"{unexplained:.1%} of the motors' limits unexplained"
    )
    wide = process._replace(disturbance=BAND * band)
    make = estimator_of(estimator, plant.layout, wide, delay=prepared.delay)
    tuned = tune(
        fitted.dynamics, plant.layout, hardware, estimator=make, late=prepared.delay % 1, seed=seed, recover=recover
    )
    say(
        f"tuned by {tuned.way}: {tuned.trials} trials, {tuned.worked:.1%} of the first sets worked; margin "
        f"{tuned.margin:.0%}, up in {tuned.seconds:.2f} s"
    )
    return Learned(prepared, fitted, tuned, time.perf_counter() - began)


def model_of(recording: Trajectories) -> Dynamics:
    """The identified model of a recording of q and commanded torques; `InputError` if it states no needs."""
    if recording.needs is None:
        raise InputError("the recording states no needs of its plant; pass one that explore has made")
    return identified_chain(prepare(recording, chain=True), recording.needs).dynamics


def try_plant(
    make: Callable[..., Plant],
    tuned: Tuned,
    *,
    starts: int = 100,
    seed: int = 1000,
    seconds: float = SECONDS,
    push: Push | None = None,
) -> tuple[Trials, list[PlantRun]]:
    """Swings up plants from many starts, in step; errors as for `run`.

    Args:
        make: seed -> a simulated plant with its own start and noise.
        seed: seed of the first plant; the others follow.
        seconds: duration of a trial, s.
        push: push on every plant.
    """
    plants = [make(seed=seed + number) for number in range(starts)]
    layout = plants[0].layout
    act = compiled(tuned.controller, layout)
    runs = run(plants, act, start_of(tuned.controller, starts), seconds=seconds, push=push)
    return judged_runs(runs, layout, seconds=seconds), runs


class Obtained(NamedTuple):
    """A model and its origin."""

    dynamics: Dynamics
    fitted: FittedPlant | None
    """`None` for models that are not learned."""
    prepared: PreparedRecording | None
    seconds: float
    """Learning time, compilation included."""


def obtain(
    plant: DesktopPlant, model: str, recording: Trajectories, *, seed: int, report: ProgressReport = silent
) -> Obtained:
    """The model with this name.

    Args:
        plant: the plant; only "analytic" and "known" use its nominal model and friction.
        model: one of `MODELS`.
        recording: data for learning the other two models.
        seed: seed of the network's initial parameters.
        report: called with the progress of its training.
    """
    known = {"analytic": nominal_model, "known": model_of_plant}
    if model in known:
        return Obtained(known[model](plant), None, None, 0.0)
    began, needs = time.perf_counter(), plant.scene.needs
    prepared = prepare(recording)
    if model == "delan":
        fitted = learned(prepared, needs, seed=seed, report=report)
    else:
        fitted = identified(prepared.train, needs)
    return Obtained(fitted.dynamics, fitted, prepared, time.perf_counter() - began)


def errors_along(plant: DesktopPlant, model: Dynamics, runs: ClosedLoopRun) -> tuple[float, float]:
    """Normalised errors of a model's torques and accelerations along true runs [E, N].

    They are sums of squared errors over sums of squares of the truth, at the plant's own states and forces.
    """
    B = np.asarray(plant.scene.needs.actuation)
    x, u = (jnp.asarray(array.reshape(-1, array.shape[-1])) for array in (runs.x[:, :-1], runs.u))
    truth = field_of(model_of_plant(plant), B)

    def squares(x: Array, u: Array) -> tuple[Array, ...]:
        q, qd = jnp.split(x, 2)
        tau, qdd = jnp.asarray(B) @ u, truth(x, u)[2:]
        off = model.inverse_dynamics(q, qd, qdd) - tau, model.forward_dynamics(q, qd, tau) - qdd
        return tuple(jnp.sum(array**2) for array in (*off, tau, qdd))

    torque, acceleration, of_torque, of_acceleration = (np.sum(array) for array in jax.jit(jax.vmap(squares))(x, u))
    return float(torque / of_torque), float(acceleration / of_acceleration)


def recorded(plant: DesktopPlant, *, seconds: float, seed: int) -> Trajectories:
    """Recording of an exploration of the plant."""
    return explore(simulated_plant(plant, seed=seed), model_of, Exploration(seconds=seconds), seed=seed).recording


def test_motions(plant: DesktopPlant, *, seed: int, seconds: float = 12.0) -> ClosedLoopRun:
    """True motions [E, N] under the torques of another exploration, replayed without noise from hanging."""
    blind, seed = Exploration(seconds=seconds, blind=(0.4, 0.8), surplus=()), seed + TEST_SEED
    recording = explore(simulated_plant(plant, seed=seed), model_of, blind, seed=seed).recording
    B = np.asarray(plant.scene.needs.actuation)
    episodes = [recording.tau[recording.trajectory == k] @ B for k in np.unique(recording.trajectory)]
    samples = min(map(len, episodes))

    def replay(u: Array) -> ClosedLoopRun:
        return simulate(
            field_of(model_of_plant(plant), B),
            Controller(jnp.asarray(0), lambda k, t, y: (k + 1, u[k])),
            np.array([0.0, np.pi, 0.0, 0.0]),
            seconds=samples / plant.rate,
            rate=plant.rate,
            controls=B.shape[1],
            hardware=plant.hardware._replace(control_noise=0.0),
            substeps=plant.substeps,
        )

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(replay))(np.stack([u[:samples] for u in episodes])))
