"""Measure the verdict on fits of simulated robots: sound logs must be good, spoiled ones refused.

Logs of random arms are identified as the command identify does, from a robot's file with rough masses; logs of two
joints are also fitted by a tree of unknown frames, as train_delan does without a file.
"""

import contextlib
import io
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dln_jax.commands import identify, train_delan
from dln_jax.data.robot_files import mjcf
from dln_jax.data.robots import Robot
from dln_jax.errors import FitRefused
from dln_jax.files import read_json
from dln_jax.mechanics.trees.description import dh_frames, serial
from dln_jax.mechanics.trees.inertia import inertial_parameters
from dln_jax.metrics.verdict import LEVELS
from dln_jax.precision import in_float64
from dln_jax.runs.arguments import arguments_of
from dln_jax.types import InputError
from scripts.reports.robots.simulated_arms import Arm, arm_torques, waves
from scripts.reports.run import AtLeast, Case, Numbers

JOINTS, NOISES = (2, 3, 4, 6), (0.0, 0.01, 0.05, 0.1)
"""Joints of successive arms, and standard deviations of the torque noise relative to the torque's own."""
REFUSED = (
    "flipped-sign",
    "all-signs-flipped",
    "swapped-columns",
    "millinewton-metres",
    "torques-of-another-motion",
    "degrees",
)
"""Faults that must be refused."""
DOUBTFUL = ("rates-exchanged", "spikes", "late-by-200-ms", "dead-channel")
"""Faults that must at least be doubtful."""
OF_TREES = ("flipped-sign", "swapped-columns", "torques-of-another-motion", "rates-exchanged", "spikes")
"""Faults of the logs that trees with unknown joint frames are fitted to."""
TRAJECTORIES, SECONDS, RATE = 5, 8.0, 100.0
Arrays = dict[str, Any]


def identified(*, logs: int = 6, seed: int = 100) -> Numbers:
    """Shares of the verdicts of `identify`, by kind of fault; each log is of an arm of its own."""
    numbers = [(number, JOINTS[number % len(JOINTS)]) for number in range(seed, seed + logs)]
    return shares(identify, "identify", ("sound", *REFUSED, *DOUBTFUL), numbers)


def learned(*, learned: int = 2, seed: int = 100) -> Numbers:
    """Shares of the verdicts of `train_delan --model learned-tree`, without a robot's file."""
    numbers = [(number, 2) for number in range(seed, seed + learned)]
    options = {"model": "learned-tree"}
    return shares(train_delan, "learned-tree", ("sound", *OF_TREES), numbers, **options)


def shares(
    command, name: str, faults: Sequence[str], logs: Sequence[tuple[int, int]], **options
) -> dict[str, dict[str, float]]:
    """Shares of each level over the logs, whose seeds and numbers of joints are stated."""
    numbers = {}
    for fault in faults:
        counts = Counter(verdict_of(command, seed, d, fault, **options) for seed, d in logs)
        numbers[f"{name}/{fault}"] = {f"{level}_share": counts[level] / len(logs) for level in LEVELS}
    return numbers


def verdict_of(command, seed: int, d: int, fault: str, **options) -> str:
    """The verdict that a command stores in its run folder; "refused" if it rejects the data."""
    arm, arrays = spoiled_log(seed, d, fault)
    with tempfile.TemporaryDirectory(prefix="dln_jax-") as name:
        folder = Path(name)
        np.savez(folder / "log.npz", **arrays)
        if command is identify:
            options["robot"] = folder / "arm.xml"
            options["robot"].write_text(mjcf(rough_file(arm, seed)))
        options |= {"data": folder / "log.npz", "out": folder / "run", "accept_log": fault != "sound"}
        try:
            with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(FitRefused):
                command.main(arguments_of(command.Arguments, **options, figures=False, uncertainty=False))
        except InputError:
            return "refused"
        return read_json(folder / "run" / "config.json", remedy="measure again")["chosen"]["verdict"]["level"]


def random_arm(seed: int, d: int) -> Arm:
    """A serial arm of d revolute joints, planar or spatial, with physically consistent inertias and friction."""
    random = np.random.default_rng([seed, d, 0])
    planar = random.random() < 0.3
    turns = np.zeros(d) if planar else random.choice((0.0, -np.pi / 2, np.pi / 2, 0.0, 0.6), d)
    turns[0] = np.pi / 2 if not turns.any() else turns[0]
    rows = np.column_stack([turns, random.uniform(0.1, 0.4, d), random.uniform(0.0, 0.3, d), random.uniform(-1, 1, d)])
    bodies = []
    for link in range(d):
        mass = 3.0 * 0.75**link * random.uniform(0.7, 1.4)
        points = random.uniform(-0.1, 0.1, (6, 3)) + random.uniform(-0.1, 0.2, 3)  # six points of equal mass
        away = points - points.mean(axis=0)
        about = mass / 6 * (np.sum(away**2) * np.eye(3) - away.T @ away)
        bodies.append(np.asarray(inertial_parameters(mass, points.mean(axis=0), about)))
    size = 0.8 ** np.arange(d)
    return Arm(
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
    none = np.zeros(len(factors))
    tree = arm.tree._replace(inertias=np.asarray(arm.tree.inertias) * factors, armature=none)
    return Robot(tree, none, none, arm.limits, np.tile([-np.inf, np.inf], (len(factors), 1)))


@in_float64
def spoiled_log(seed: int, d: int, fault: str) -> tuple[Arm, Arrays]:
    """A random arm and its log with a fault: motions of five sines per joint, white noise on the torques."""
    arm, random = random_arm(seed, d), np.random.default_rng([seed, 2])
    t, states = np.arange(0.0, SECONDS, 1 / RATE), []
    for _ in range(TRAJECTORIES):
        w = 2 * np.pi * random.uniform(0.1, 1.0, (5, d))
        a, phase = random.uniform(0.2, 0.8, (5, d)) / (1 + w), random.uniform(0, 2 * np.pi, (5, d))
        states.append(waves(a, w, w * t[:, None, None] + phase, axis=1))
    q, qd, qdd = map(np.concatenate, zip(*states, strict=True))
    tau = arm_torques(arm, q, qd, qdd, friction=True)
    noise = NOISES[(3 * seed + seed // len(JOINTS)) % len(NOISES)]
    tau = tau + noise * tau.std(axis=0) * random.normal(size=tau.shape)
    random = np.random.default_rng([seed, 3])
    match fault:
        case "flipped-sign" | "dead-channel":
            tau[:, random.integers(d)] *= -1.0 if fault == "flipped-sign" else 0.0
        case "all-signs-flipped":
            tau = -tau
        case "swapped-columns":
            tau = tau[:, ::-1]
        case "millinewton-metres":
            tau = 1e3 * tau
        case "rates-exchanged":
            qd, qdd = qdd, qd
        case "torques-of-another-motion":
            tau = np.roll(tau, len(tau) // 3, axis=0)
        case "degrees":
            q, qd, qdd = map(np.degrees, (q, qd, qdd))
        case "spikes":  # of 20 standard deviations in 1 of 100 samples
            hit = random.random(tau.shape) < 0.01
            tau = tau + hit * random.choice([-20, 20], hit.shape) * tau.std(axis=0)
        case "late-by-200-ms":
            tau = np.roll(tau, int(0.2 * RATE), axis=0)
    arrays = {"t": np.tile(t, TRAJECTORIES), "q": q, "qd": qd, "qdd": qdd, "tau": tau}
    return arm, {**arrays, "trajectory": np.repeat(np.arange(TRAJECTORIES), len(t))}


CASES = (
    Case(
        "identify/logs",
        identified,
        quick={"logs": 1},
        bound={
            "identify/sound good_share": AtLeast(1.0),
            **{f"identify/{fault} refused_share": AtLeast(1.0) for fault in REFUSED},
            **{f"identify/{fault} good_share": 0.0 for fault in DOUBTFUL},
        },
    ),
    Case(
        "learned-tree/logs",
        learned,
        quick={"learned": 1},
        bound={
            # The arms' friction has offsets, which such a tree does not model.
            "learned-tree/sound refused_share": 0.0,
            **{f"learned-tree/{fault} good_share": 0.0 for fault in OF_TREES},
        },
    ),
)
