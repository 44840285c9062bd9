"""Verdicts on fits of random arms: sound logs must be good, logs with faults refused or doubtful.

Each log is identified as the command identify does, from a robot's file with rough masses; logs of two joints are also
fitted by a tree of unknown frames, as train_delan does without a file.
"""

import contextlib
import io
import tempfile
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dln_jax.cli.arguments import arguments_of
from dln_jax.cli.commands import identify, train_delan
from dln_jax.data.robot_files import mjcf
from dln_jax.data.robots import Robot
from dln_jax.errors import FitRefused
from dln_jax.files import read_json
from dln_jax.mechanics.trees import dh_frames, inertial_parameters, serial
from dln_jax.metrics.verdict import LEVELS
from dln_jax.precision import in_float64
from dln_jax.types import InputError
from scripts.reports.case import Case, Findings
from scripts.reports.robots.simulated_arms import Arm, arm_torques
from scripts.reports.rows import Row, expect

JOINTS = (2, 3, 4, 6)
"""Numbers of joints of successive arms."""
NOISES = (0.0, 0.01, 0.05, 0.1)
"""Standard deviations of the torque noise, relative to the torque's own."""
LEARNED_JOINTS = 2
LEARNED_FAULTS = ("flipped-sign", "swapped-columns", "torques-of-another-motion", "rates-exchanged", "spikes")
"""Faults of the logs that trees with unknown joint frames are fitted to."""
Arrays = dict[str, Any]
TRAJECTORIES, SECONDS, RATE = 5, 8.0, 100.0
TURNS = (0.0, -np.pi / 2, np.pi / 2, 0.0, 0.6)
"""Angles between successive axes of random arms, rad; 0 gives a planar arm."""


class Fault(NamedTuple):
    """A change of a sound log's arrays, and the verdict it must lead to."""

    spoil: Callable[[Arrays, np.random.Generator], Arrays]
    level: str
    """"refused", or "doubtful" if that suffices."""


def random_arm(seed: int, d: int) -> Arm:
    """A serial arm of d revolute joints, planar or spatial, with physically consistent inertias and friction."""
    random = np.random.default_rng([seed, d, 0])
    turns = np.zeros(d) if random.random() < 0.3 else random.choice(TURNS, d)
    turns[0] = np.pi / 2 if not turns.any() else turns[0]
    rows = np.column_stack([turns, random.uniform(0.1, 0.4, d), random.uniform(0.0, 0.3, d), random.uniform(-1, 1, d)])
    bodies = [_body(3.0 * 0.75**link * random.uniform(0.7, 1.4), random) for link in range(d)]
    size = 0.8 ** np.arange(d)
    return Arm(
        f"arm-{d}-{seed}",
        serial(*dh_frames(rows), bodies, armature=0.1 * size * random.uniform(0.3, 1, d)),
        viscous=0.4 * size * random.uniform(0.2, 1, d),
        coulomb=0.5 * size * random.uniform(0.2, 1, d),
        offset=0.1 * size * random.normal(size=d),
        limits=np.tile([-2.5, 2.5], (d, 1)),
        rates=np.full(d, 2.5),
        accelerations=np.full(d, 12.0),
    )


def rough_file(arm: Arm, seed: int) -> Robot:
    """The arm as in an unmeasured file: masses wrong by about a third, no armature, no friction."""
    factors = np.exp(np.random.default_rng([seed, 1]).normal(0.0, 0.3, (len(arm.tree.inertias), 1)))
    tree = arm.tree._replace(inertias=np.asarray(arm.tree.inertias) * factors, armature=np.zeros(len(factors)))
    none = np.zeros(len(factors))
    return Robot(tree, none, none, arm.limits, np.tile([-np.inf, np.inf], (len(factors), 1)))


@in_float64
def sound_log(arm: Arm, seed: int, noise: float) -> Arrays:
    """Motions of five sines per joint; torques have white noise, `noise` times their standard deviation."""
    random, d = np.random.default_rng([seed, 2]), len(arm.rates)
    t = np.arange(0.0, SECONDS, 1 / RATE)
    states = []
    for _ in range(TRAJECTORIES):
        w = 2 * np.pi * random.uniform(0.1, 1.0, (5, d))
        a, phase = random.uniform(0.2, 0.8, (5, d)) / (1 + w), random.uniform(0, 2 * np.pi, (5, d))
        angle = w * t[:, None, None] + phase
        states.append(
            [np.sum(x, axis=1) for x in (a * np.sin(angle), a * w * np.cos(angle), -a * w**2 * np.sin(angle))]
        )
    q, qd, qdd = map(np.concatenate, zip(*states, strict=True))
    tau = arm_torques(arm, q, qd, qdd, friction=True)
    tau = tau + noise * tau.std(axis=0) * random.normal(size=tau.shape)
    return {
        "t": np.tile(t, TRAJECTORIES), "q": q, "qd": qd, "qdd": qdd, "tau": tau,
        "trajectory": np.repeat(np.arange(TRAJECTORIES), len(t)),
    }  # fmt: skip


def _one_channel(factor: float, log: Arrays, random: np.random.Generator) -> Arrays:
    joints = np.arange(log["tau"].shape[1])
    return {**log, "tau": np.where(joints == random.integers(len(joints)), factor, 1.0) * log["tau"]}


def _spikes(log: Arrays, random: np.random.Generator) -> Arrays:
    hit = random.random(log["tau"].shape) < 0.01
    return {**log, "tau": log["tau"] + hit * random.choice([-20, 20], hit.shape) * log["tau"].std(axis=0)}


def _late(samples: Callable[[Arrays], int], log: Arrays, random: np.random.Generator) -> Arrays:
    return {**log, "tau": np.roll(log["tau"], samples(log), axis=0)}


FAULTS: dict[str, Fault] = {
    "flipped-sign": Fault(partial(_one_channel, -1.0), "refused"),
    "all-signs-flipped": Fault(lambda log, random: {**log, "tau": -log["tau"]}, "refused"),
    "swapped-columns": Fault(lambda log, random: {**log, "tau": log["tau"][:, ::-1]}, "refused"),
    "millinewton-metres": Fault(lambda log, random: {**log, "tau": 1e3 * log["tau"]}, "refused"),
    "rates-exchanged": Fault(lambda log, random: {**log, "qd": log["qdd"], "qdd": log["qd"]}, "doubtful"),
    "torques-of-another-motion": Fault(partial(_late, lambda log: len(log["t"]) // 3), "refused"),
    "degrees": Fault(
        lambda log, random: {**log, **{key: np.degrees(log[key]) for key in ("q", "qd", "qdd")}}, "refused"
    ),
    "spikes": Fault(_spikes, "doubtful"),
    "late-by-200-ms": Fault(partial(_late, lambda log: int(0.2 * RATE)), "doubtful"),
    "dead-channel": Fault(partial(_one_channel, 0.0), "doubtful"),
}
"""Faults by name. Spikes are torques of 20 standard deviations in 1 of 100 samples."""


def _body(mass: float, random: np.random.Generator) -> np.ndarray:
    """Six points of equal mass."""
    points = random.uniform(-0.1, 0.1, (6, 3)) + random.uniform(-0.1, 0.2, 3)
    away = points - points.mean(axis=0)
    about = mass / 6 * (np.sum(away**2) * np.eye(3) - away.T @ away)
    return np.asarray(inertial_parameters(mass, points.mean(axis=0), about))


def cases(logs: int, learned: int, seed: int) -> list[Case]:
    """One case per kind of log: `logs` arms are identified, and `learned` fitted by trees of unknown frames."""
    kinds = [(f"identify/{name}", logs, identified_arm) for name in ("sound", *FAULTS)]
    if learned:
        kinds += [(f"learned-tree/{name}", learned, learned_tree) for name in ("sound", *LEARNED_FAULTS)]
    return [Case(name, partial(findings, name, count, fit, seed)) for name, count, fit in kinds]


def findings(case: str, logs: int, verdict_of: Callable[[int, Fault | None], str], seed: int) -> Findings:
    """Shares of the verdicts over the logs; the kind of log is the last part of the case's name."""
    fault, with_frames = FAULTS.get(case.rpartition("/")[2]), case.startswith("identify")
    counts = Counter(verdict_of(seed + number, fault) for number in range(logs))
    shares = {level: counts[level] / logs for level in LEVELS}
    rows = [Row(case, f"{level}_share", shares[level]) for level in LEVELS]
    if fault is None and with_frames:
        rows[0] = expect(case, "good_share", "sound logs are good", shares["good"], 1.0, at_least=True)
    elif fault is None:  # the arms' friction has offsets, which such a tree does not model
        rows[2] = expect(case, "refused_share", "sound logs are not refused", shares["refused"], 0.0)
    elif fault.level == "refused" and with_frames:
        rows[2] = expect(case, "refused_share", "ruined", shares["refused"], 1.0, at_least=True)
    else:
        rows[0] = expect(case, "good_share", "spoiled: at least doubtful", shares["good"], 0.0)
    return Findings(rows)


def log_of(seed: int, joints: int, fault: Fault | None) -> tuple[Arm, Arrays]:
    """A random arm and its log, with the fault if there is one."""
    arm = random_arm(seed, joints)
    log = sound_log(arm, seed, NOISES[(3 * seed + seed // len(JOINTS)) % len(NOISES)])
    return arm, log if fault is None else fault.spoil(log, np.random.default_rng([seed, 3]))


def identified_arm(seed: int, fault: Fault | None) -> str:
    """The verdict of `identify` on one log."""
    arm, log = log_of(seed, JOINTS[seed % len(JOINTS)], fault)

    def fit(folder: Path, **options: Any) -> None:
        (folder / "arm.xml").write_text(mjcf(rough_file(arm, seed)))
        identify.main(arguments_of(identify.Arguments, robot=folder / "arm.xml", **options))

    return _verdict(log, fit, accepted=fault is not None)


def learned_tree(seed: int, fault: Fault | None) -> str:
    """The verdict of `train_delan --model learned-tree` on one log, without a robot's file."""
    _, log = log_of(seed, LEARNED_JOINTS, fault)

    def fit(folder: Path, **options: Any) -> None:
        train_delan.main(arguments_of(train_delan.Arguments, model="learned-tree", low_latency=False, **options))

    return _verdict(log, fit, accepted=fault is not None)


def _verdict(log: Arrays, fit: Callable[..., None], *, accepted: bool) -> str:
    """The verdict that a command stores in its run folder; "refused" if the command rejects the input.

    If the log check finds errors, `accepted` logs are fitted all the same, and others are refused.
    """
    with tempfile.TemporaryDirectory(prefix="dln_jax-") as name:
        folder = Path(name)
        np.savez(folder / "log.npz", **log)
        options = {"data": folder / "log.npz", "out": folder / "run", "uncertainty": False, "figures": False}
        try:
            with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(FitRefused):
                fit(folder, accept_log=accepted, **options)
        except InputError:
            return "refused"
        return read_json(folder / "run" / "config.json", remedy="measure again")["chosen"]["verdict"]["level"]
