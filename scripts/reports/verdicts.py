"""Verdicts on fits: sound logs and motions must be good, spoiled ones and plants that no model describes must not.

Logs of random arms are identified as the command identify does, from a robot's file with rough masses; logs of two
joints are also fitted by a tree of unknown frames, as train_delan does without a file. Motions are fitted by
train_hnn_task.
"""

import contextlib
import io
import json
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from dln_jax.cli.arguments import arguments_of
from dln_jax.cli.commands import identify, train_delan, train_hnn_task
from dln_jax.data import Robot
from dln_jax.data.robot_files import mjcf
from dln_jax.errors import FitRefused
from dln_jax.files import read_json
from dln_jax.mechanics.trees import dh_frames, inertial_parameters, serial
from dln_jax.metrics.verdict import LEVELS
from dln_jax.precision import in_float64
from dln_jax.types import InputError
from scripts.reports.robots.simulated_arms import Arm, arm_torques
from scripts.reports.run import Numbers

JOINTS, NOISES = (2, 3, 4, 6), (0.0, 0.01, 0.05, 0.1)
"""Joints of successive arms, and standard deviations of the torque noise relative to the torque's own."""
REFUSED = (
    *("flipped-sign", "all-signs-flipped", "swapped-columns", "millinewton-metres", "torques-of-another-motion"),
    "degrees",
)
"""Faults that must be refused."""
DOUBTFUL = ("rates-exchanged", "spikes", "late-by-200-ms", "dead-channel")
"""Faults that must at least be doubtful."""
OF_TREES = ("flipped-sign", "swapped-columns", "torques-of-another-motion", "rates-exchanged", "spikes")
"""Faults of the logs that trees with unknown joint frames are fitted to."""
TRAJECTORIES, SECONDS, RATE, MOTIONS = 5, 8.0, 100.0, 12
Arrays = dict[str, Any]


def identified(*, logs: int = 6, seed: int = 100) -> Numbers:
    """Shares of the verdicts of `identify`, by kind of fault; each log is of an arm of its own."""

    def verdict(number: int, fault: str) -> str:
        arm, log = spoiled_log(number, JOINTS[number % len(JOINTS)], fault)
        rough = mjcf(rough_file(arm, number))
        return verdict_of(identify, log, robot=rough, uncertainty=False, accept_log=fault != "sound")

    return shares("identify", ("sound", *REFUSED, *DOUBTFUL), logs, seed, verdict)


def learned(*, learned: int = 2, seed: int = 100) -> Numbers:
    """Shares of the verdicts of `train_delan --model learned-tree`, without a robot's file."""

    def verdict(number: int, fault: str) -> str:
        options = {"model": "learned-tree", "low_latency": False, "uncertainty": False}
        log = spoiled_log(number, 2, fault)[1]
        return verdict_of(train_delan, log, **options, accept_log=fault != "sound")

    return shares("learned-tree", ("sound", *OF_TREES), learned, seed, verdict)


def shares(name: str, faults: tuple[str, ...], logs: int, seed: int, verdict: Callable[[int, str], str]) -> Numbers:
    """Shares of each level over the logs."""
    numbers = {}
    for fault in faults:
        counts = Counter(verdict(seed + number, fault) for number in range(logs))
        numbers[f"{name}/{fault}"] = {f"{level}_share": counts[level] / logs for level in LEVELS}
    return numbers


def verdict_of(command: Any, arrays: Arrays, *, robot: str | None = None, **options: Any) -> str:
    """The verdict that a command stores in its run folder; "refused" if it rejects the data."""
    with tempfile.TemporaryDirectory(prefix="dln_jax-") as name:
        folder = Path(name)
        np.savez(folder / "log.npz", **arrays)
        if robot is not None:
            (folder / "arm.xml").write_text(robot)
            options["robot"] = folder / "arm.xml"
        options |= {"data": folder / "log.npz", "out": folder / "run", "figures": False}
        try:
            with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(FitRefused):
                command.main(arguments_of(command.Arguments, **options))
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
        angle = w * t[:, None, None] + phase
        waves = a * np.sin(angle), a * w * np.cos(angle), -a * w**2 * np.sin(angle)
        states.append([np.sum(wave, axis=1) for wave in waves])
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


class Plant(NamedTuple):
    """A plant and how it is recorded."""

    rates: str
    start: str
    seconds: float
    rate: float
    joints: tuple[str, ...]
    good: bool
    """Whether the verdict must be good; otherwise it must not."""
    keys: str = "q"
    """Columns of the file: of q, p (momenta), r (their rates), v (velocities)."""
    noise: float = 0.0
    """Of q and p."""
    friction: bool = False


SLIDE, TURN = ("prismatic",), ("revolute",)
RATES: dict[str, Callable[[float, np.ndarray], Any]] = {
    "spring": lambda t, x: (x[1], -4 * x[0]),
    "pendulum": lambda t, x: (x[1], -9.81 * np.sin(x[0])),
    "damped-pendulum": lambda t, x: (x[1], -9.81 * np.sin(x[0]) - 0.2 * x[1]),
    "forced-duffing": lambda t, x: (x[1], x[0] - x[0] ** 3 - 0.3 * x[1] + 0.5 * np.cos(1.2 * t)),
    "lotka-volterra": lambda t, x: (x[0] * (1 - x[1]), -x[1] * (1 - x[0])),
    "random-walk": lambda t, x: 0 * x,
}
"""t and (q, p) of all coordinates -> their rates."""
STARTS: dict[str, Callable[[np.random.Generator], Any]] = {
    "anywhere": lambda random: random.uniform(-1.5, 1.5, 2),
    "swing": lambda random: (random.uniform(-2.5, 2.5), 0.0),
    "animals": lambda random: random.uniform(0.3, 2.0, 2),
}
PLANTS = {
    "spring-noisy-momenta": Plant("spring", "anywhere", 6, 20, SLIDE, True, "qpr", 0.1),
    "pendulum": Plant("pendulum", "swing", 6, 100, TURN, True),
    "pendulum-coarse": Plant("pendulum", "swing", 12, 5, TURN, True),
    "damped-pendulum": Plant("damped-pendulum", "swing", 8, 50, TURN, True, "qv", friction=True),
    "lotka-volterra": Plant("lotka-volterra", "animals", 13.5, 20, SLIDE, False, "qpr"),
    "forced-duffing": Plant("forced-duffing", "anywhere", 15, 100, SLIDE, False, friction=True),
    "random-walk": Plant("random-walk", "anywhere", 7.4, 50, SLIDE, False),
}
"""Plants by name; the random walk has no rates."""


def motions(*, motions: int = 1, seed: int = 100) -> Numbers:
    """Shares of wrong verdicts of `train_hnn_task`: sound plants that are not good, or others that are."""
    numbers = {}
    for name, plant in PLANTS.items():
        needs = json.dumps({"joints": plant.joints, "gravity": True} | ({"friction": True} if plant.friction else {}))
        options = {"task": "measured", "needs": needs, "low_latency": False}
        files = (recorded(name, plant, seed + number) for number in range(motions))
        good = [verdict_of(train_hnn_task, file, **options) == "good" for file in files]
        numbers[f"motions/{name}"] = {"wrong_share": np.mean(np.array(good) != plant.good)}
    return numbers


def recorded(name: str, plant: Plant, seed: int) -> Arrays:
    """Motions that SciPy integrates, with nothing but the stated columns."""
    random, states, d = np.random.default_rng([seed, len(name)]), [], len(plant.joints)
    t = np.arange(0.0, plant.seconds, 1 / plant.rate)
    for _ in range(MOTIONS):
        start = STARTS[plant.start](random)
        solved = solve_ivp(RATES[plant.rates], (0, t[-1]), start, "DOP853", t, rtol=1e-9, atol=1e-9)
        states.append(solved.y.T)
    if name == "random-walk":
        states = [np.cumsum(0.1 * random.normal(size=state.shape), axis=0) for state in states]
    every, times = np.concatenate(states), np.tile(t, MOTIONS)
    rates = np.array([RATES[plant.rates](at, x) for at, x in zip(times, every, strict=True)])
    half = every.shape[1] // 2
    noisy = every + plant.noise * random.normal(size=every.shape)
    columns = {
        "q": {"q": noisy[:, :d]},
        "p": {"p": noisy[:, half : half + d]},
        "v": {"qd": every[:, half : half + d]},
        "r": {"qd": rates[:, :d], "pd": rates[:, half : half + d]},
    }
    arrays = {"t": times, "trajectory": np.repeat(np.arange(MOTIONS), len(t))}
    return arrays | {key: array for kind in plant.keys for key, array in columns[kind].items()}
