"""Error rates of the log validation: false findings on sound logs, and planted faults that it misses.

Arms have random frames and two to seven joints; some are branched, and one is the Panda. They move from point to point,
wait, and shake. Torques have noise, friction with a Stribeck curve, or neither; encoders have steps and noise.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from dln_jax.compilation import quick_compilation
from dln_jax.data import Robot, schema
from dln_jax.data.checks import Finding, quick
from dln_jax.mechanics import trees
from scripts.reports.robots.simulated_arms import panda
from scripts.reports.run import Numbers

SEED = 20_000
"""First seed of the reported logs; thresholds were chosen on other arms, motions and seeds."""
STATEMENTS = {"split", "condition", "unexcited", "raw-differences", "gaps", "jitter", "quantisation", "rates"}
"""Checks that state how a log was recorded, not that it is wrong."""
FAULTS = {
    "swapped-columns": "order",
    "flipped-sign": "torque-sign",
    "delay": "delay",
    "degrees": "q-unit",
    "millinewton-metres": "gear",
    "rates-exchanged": "qd-exchanged",
    "repeated-rows": "repeated",
    "spikes": "spikes",
    "dead-channel": "dead-torque",
    "saturated-torque": "saturation-tau",
    "wrong-sampling-time": "clock",
    "tilted-base": "gravity",
}
"""Findings that name the faults."""
WITH_ROBOT = ("millinewton-metres", "wrong-sampling-time", "tilted-base")
"""Faults that a log without its robot cannot show."""
Arrays = dict[str, Any]


def sound(*, logs: int = 60) -> Numbers:
    """The share of sound logs with a false error or warning; every other log repeats rows."""
    alarms: dict[str, list[bool]] = {"without-robot": [], "with-robot": []}
    for number in range(logs):
        repeats = number % 2 == 1
        robot, arrays, _ = drawn(number, repeats=repeats)
        true = STATEMENTS | ({"repeated"} if repeats else set())
        for name, known in zip(alarms, (None, robot), strict=True):
            alarms[name].append(any(finding.check not in true for finding in findings(arrays, known)))
    return {f"log-checks/sound-{name}": {"false_alarms": np.mean(values)} for name, values in alarms.items()}


def faults(*, faulty_logs: int = 10) -> Numbers:
    """The share of faulty logs whose fault is detected and named."""
    numbers = {}
    for place, (kind, check) in enumerate(FAULTS.items()):
        measured = []
        for number in range(faulty_logs):
            robot, arrays, rates = drawn(1000 + 100 * place + number)
            robot, arrays = spoiled(kind, robot, arrays, rates, np.random.default_rng([SEED, number, 2]))
            measured.append(any(finding.check == check for finding in findings(arrays, robot)))
        numbers[f"log-checks/{kind}"] = {"found": np.mean(measured)}
    return numbers


def findings(arrays: Arrays, robot: Robot | None) -> list[Finding]:
    """Errors and warnings of the quick checks."""
    return [finding for finding in quick(schema.from_arrays(arrays), robot) if finding.severity != "note"]


def spoiled(
    kind: str, robot: Robot, arrays: Arrays, rates: tuple[np.ndarray, np.ndarray], random: np.random.Generator
) -> tuple[Robot | None, Arrays]:
    """The robot, if the check gets it, and the log with a fault."""
    t, q, tau = arrays["t"], arrays["q"], arrays["tau"].copy()
    changed: Arrays = {}
    d = q.shape[1]
    match kind:
        case "swapped-columns":
            pair = random.choice(d, 2, replace=False)
            tau[:, pair] = tau[:, pair[::-1]]
        case "flipped-sign":
            tau[:, random.integers(d)] *= -1
        case "delay":
            tau = late(arrays, random.uniform(0.005, 0.05))
        case "degrees":
            q = np.degrees(q)
        case "millinewton-metres":
            tau *= 1000
        case "rates-exchanged":
            changed = {"qd": rates[1], "qdd": rates[0]}
        case "repeated-rows":
            return None, repeat_rows(arrays, random)
        case "spikes":
            joint = random.integers(d)
            places = random.choice(np.arange(10, len(tau) - 10), 10, replace=False)
            tau[places, joint] += random.choice([-1, 1], 10) * random.uniform(4, 10, 10) * tau[:, joint].std()
        case "dead-channel":
            tau[:, random.integers(d)] = 0
        case "saturated-torque":
            values = tau[:, random.integers(d)]
            values[:] = np.clip(values, *np.quantile(values, random.uniform([0.03, 0.9], [0.1, 0.97])))
        case "wrong-sampling-time":
            t = t * random.choice([0.5, 0.8, 1.25, 2.0])
        case "tilted-base":
            axis, angle = random.normal(size=3), np.radians(random.uniform(10, 40))
            down = np.asarray(robot.tree.gravity, float)
            axis = np.cross(down, axis)
            axis /= np.linalg.norm(axis)
            turned = np.cos(angle) * down + np.sin(angle) * np.cross(axis, down)
            robot = robot._replace(tree=robot.tree._replace(gravity=turned))
    return robot if kind in WITH_ROBOT else None, {**arrays, "t": t, "q": q, "tau": tau, **changed}


def late(arrays: Arrays, seconds: float) -> np.ndarray:
    """Torques that are late by whole samples, at least one."""
    shift = max(1, round(seconds / float(arrays["t"][1] - arrays["t"][0])))
    tau = arrays["tau"].copy()
    for index in np.unique(arrays["trajectory"]):
        here = arrays["trajectory"] == index
        tau[here] = np.concatenate([np.repeat(tau[here][:1], shift, 0), tau[here][:-shift]])
    return tau


def repeat_rows(arrays: Arrays, random: np.random.Generator) -> Arrays:
    """One row in fifty to two hundred holds the values of the one before."""
    rows = np.arange(7, len(arrays["t"]) - 7, int(random.integers(50, 200)))
    changed = {key: arrays[key].copy() for key in ("q", "tau")}
    for values in changed.values():
        values[rows] = values[rows - 1]
    return {**arrays, **changed}


@functools.cache
def random_arm(seed: int, d: int) -> tuple[Robot, Callable[..., Any]]:
    """An arm with random frames, and its torques; every third is branched, and one with seven joints is the Panda.

    Arms are cached because their programs take long to compile.
    """
    random = np.random.default_rng([seed, d])
    tree = panda().tree
    if d != 7 or seed % 2 == 0:
        parents = [-1] + [k - 1 - int(seed % 3 == 0 and k == d - 1 and d > 2) for k in range(1, d)]
        turns = [np.linalg.qr(random.normal(size=(3, 3)))[0] for _ in range(d)]
        if seed % 4 == 1:  # parallel axes
            turns = [np.eye(3)] * d
        turns = [turn * np.sign(np.linalg.det(turn)) for turn in turns]
        positions = random.uniform([-0.2, -0.3, -0.3], [0.4, 0.3, 0.3], (d, 3))
        masses = np.geomspace(5.0, 0.5, d) * random.uniform(0.6, 1.5, d)
        links = [
            trees.inertial_parameters(m, random.uniform(-0.2, 0.2, 3), m * 0.02 * np.diag(random.uniform(1, 2, 3)))
            for m in masses
        ]
        gravity = (9.81, 0.0, 0.0) if seed % 4 == 1 else (0.0, 0.0, -9.81)
        tree = trees.make_tree(
            parents, ["revolute"] * d, turns, positions, [[0, 0, 1]] * d, links,
            armature=random.uniform(0.0, 0.1, d), gravity=gravity,
        )  # fmt: skip
    forces = jax.jit(jax.vmap(lambda *x: trees.newton_euler(tree, *x)), compiler_options=quick_compilation())
    return without_friction(tree), forces


def without_friction(tree: trees.Tree) -> Robot:
    """A robot's file without friction and limits."""
    d = tree.degrees_of_freedom
    unlimited = np.tile([-np.inf, np.inf], (d, 1))
    return Robot(tree, np.zeros(d), np.zeros(d), unlimited, unlimited)


def drawn(number: int, *, repeats: bool = False) -> tuple[Robot, Arrays, tuple[np.ndarray, np.ndarray]]:
    """A robot, its log of one to four trajectories, and exact qd and qdd; `repeats`: some rows are repeated."""
    robot, torques = random_arm(SEED + (number // 6) % 2, 2 + number % 6)
    random, d = np.random.default_rng([SEED + number, 1]), robot.tree.degrees_of_freedom
    rate, runs = float(random.choice([60, 100, 125, 200, 500])), int(random.integers(1, 5))
    n = int(rate * random.uniform(15, 40) / runs)
    t = np.arange(n) / rate
    q, qd, qdd = map(np.concatenate, zip(*(motion(random, d, t) for _ in range(runs)), strict=True))
    tau = np.asarray(torques(q, qd, qdd))
    size = np.maximum(tau.std(axis=0), 1e-2 * tau.std(axis=0).max())
    if random.random() < 0.6:
        speed, dry = qd / random.uniform(0.005, 0.03), random.uniform(0.05, 0.4, d) * size
        tau = tau + dry * np.tanh(speed) * (1 + 0.3 * np.exp(-((qd / 0.1) ** 2)))
        tau = tau + random.uniform(0.02, 0.3, d) * size * qd / qd.std(axis=0) + 0.05 * size * random.normal(size=d)
    if random.random() < 0.75:
        tau = tau + random.uniform(0.005, 0.04, d) * size * random.normal(size=tau.shape)
        q = q + 10 ** random.uniform(-5.5, -3.7) * random.normal(size=q.shape)
    if random.random() < 0.3:
        step = 2 * np.pi / 2 ** random.integers(15, 20)
        q = np.round(q / step) * step
    arrays = {"t": np.tile(t, runs), "q": q, "tau": tau, "trajectory": np.repeat(np.arange(runs), n)}
    return robot, repeat_rows(arrays, random) if repeats else arrays, (qd, qdd)


def motion(random: np.random.Generator, d: int, t: np.ndarray) -> np.ndarray:
    """q, qd and qdd [3, n, d]: quintic moves between random points, and a shaking of random frequencies."""
    total = np.zeros((3, len(t), d))
    for joint in range(d):
        ends = np.cumsum(random.uniform(0.5, 1.6, 200))
        points = random.uniform(-1.2, 1.2, 201)
        place = np.minimum(np.searchsorted(ends, t, side="right"), 199)
        began = np.where(place > 0, ends[place - 1], 0.0)
        length = ends[place] - began
        total[:, :, joint] = quintic((t - began) / length, length, points[place], points[place + 1] - points[place])
        for _ in range(2):
            w, phase, size = 2 * np.pi * random.uniform(0.4, 2.0), random.uniform(0, 6.3), random.uniform(0.02, 0.12)
            wave = np.stack([np.sin(w * t + phase), w * np.cos(w * t + phase), -(w**2) * np.sin(w * t + phase)])
            total[:, :, joint] += size * wave
    return total


def quintic(x: Any, length: Any, start: Any, step: Any) -> np.ndarray:
    """Position, velocity and acceleration of a move from rest to rest, x in [0, 1] of its duration."""
    return np.stack(
        [
            start + step * x**3 * (10 - 15 * x + 6 * x**2),
            step / length * 30 * x**2 * (1 - x) ** 2,
            step / length**2 * 60 * x * (1 - x) * (1 - 2 * x),
        ]
    )
