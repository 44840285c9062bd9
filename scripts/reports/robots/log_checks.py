"""Error rates of the log validation: false findings on sound logs, and planted faults that it misses.

Arms have random frames and two to seven joints; some are branched, and one is the Panda. They move from point to point,
wait, and shake. Torques have noise, friction with a Stribeck curve, or neither; encoders have steps and noise. Faults
that a log without its robot cannot show (a tilted base, torques in mN m, a wrong clock without measured rates) are
checked with the robot, all others without. The checks are the quick ones of training commands.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from dln_jax.compilation import quick_compilation
from dln_jax.data import schema
from dln_jax.data.checks import quick
from dln_jax.data.robots import Robot
from dln_jax.mechanics import trees
from scripts.reports.case import Findings
from scripts.reports.robots.simulated_arms import panda
from scripts.reports.rows import expect

SOUND, FAULTY, QUICK = 60, 10, 6
"""Number of sound logs, of logs per kind of fault, and of sound logs in a quick run."""
SEED = 20_000
"""First seed of the reported logs; thresholds were chosen on other arms, motions and seeds."""
FALSE_ALARMS, FOUND = 0.02, 0.9
"""Largest share of false alarms, and smallest share of detected faults."""
STATEMENTS = ("split", "condition", "unexcited", "raw-differences", "gaps", "jitter", "quantisation", "rates")
"""Checks that state how a log was recorded, not that it is wrong."""

Arrays = dict[str, Any]
_Fault = Callable[[Arrays, np.random.Generator, int], Arrays]


class Simulated(NamedTuple):
    """A sound log, and its robot."""

    robot: Robot
    arrays: Arrays
    rates: tuple[np.ndarray, np.ndarray]
    """Exact qd and qdd."""
    repeated: bool


class _Arm(NamedTuple):
    robot: Robot
    torques: Callable[..., Any]


@functools.cache
def random_arm(seed: int, d: int) -> _Arm:
    """An arm with random frames; every third is branched, and one with seven joints is the Panda.

    Arms are cached because their programs take long to compile.
    """
    random = np.random.default_rng([seed, d])
    if d == 7 and seed % 2:
        tree = panda().tree
    else:
        parents = [-1] + [k - 1 - int(seed % 3 == 0 and k == d - 1 and d > 2) for k in range(1, d)]
        turns = [np.linalg.qr(random.normal(size=(3, 3)))[0] for _ in range(d)]
        if seed % 4 == 1:  # parallel axes
            turns = [np.eye(3)] * d
        turns = [turn * np.sign(np.linalg.det(turn)) for turn in turns]
        positions = random.uniform([-0.2, -0.3, -0.3], [0.4, 0.3, 0.3], (d, 3))
        masses = np.geomspace(5.0, 0.5, d) * random.uniform(0.6, 1.5, d)
        links = [
            trees.inertial_parameters(
                mass, random.uniform(-0.2, 0.2, 3), mass * 0.02 * np.diag(random.uniform(1, 2, 3))
            )
            for mass in masses
        ]
        gravity = (9.81, 0.0, 0.0) if seed % 4 == 1 else (0.0, 0.0, -9.81)
        tree = trees.make_tree(
            parents, ["revolute"] * d, turns, positions, [[0, 0, 1]] * d, links,
            armature=random.uniform(0.0, 0.1, d), gravity=gravity,
        )  # fmt: skip
    unlimited = np.tile([-np.inf, np.inf], (d, 1))
    forces = jax.jit(jax.vmap(lambda *x: trees.newton_euler(tree, *x)), compiler_options=quick_compilation())
    return _Arm(Robot(tree, np.zeros(d), np.zeros(d), unlimited, unlimited), forces)


def motion(random: np.random.Generator, d: int, t: np.ndarray) -> list[np.ndarray]:
    """q, qd and qdd [n, d]: quintic moves between random points, and a shaking of random frequencies."""
    total = [np.zeros((len(t), d)) for _ in range(3)]
    for joint in range(d):
        ends = np.cumsum(random.uniform(0.5, 1.6, 200))
        points = random.uniform(-1.2, 1.2, 201)
        place = np.minimum(np.searchsorted(ends, t, side="right"), 199)
        began = np.where(place > 0, ends[place - 1], 0.0)
        length = ends[place] - began
        x, step = (t - began) / length, points[place + 1] - points[place]
        total[0][:, joint] = points[place] + step * x**3 * (10 - 15 * x + 6 * x**2)
        total[1][:, joint] = step / length * 30 * x**2 * (1 - x) ** 2
        total[2][:, joint] = step / length**2 * 60 * x * (1 - x) * (1 - 2 * x)
        for _ in range(2):
            w, phase, size = 2 * np.pi * random.uniform(0.4, 2.0), random.uniform(0, 6.3), random.uniform(0.02, 0.12)
            wave = np.stack([np.sin(w * t + phase), w * np.cos(w * t + phase), -(w**2) * np.sin(w * t + phase)])
            for values, part in zip(total, size * wave, strict=True):
                values[:, joint] += part
    return total


def simulate(arm: _Arm, seed: int, *, repeats: bool) -> Simulated:
    """A log of one to four trajectories; `repeats`: one row in some hundred is repeated."""
    random, d = np.random.default_rng([seed, 1]), arm.robot.tree.degrees_of_freedom
    rate, runs = float(random.choice([60, 100, 125, 200, 500])), int(random.integers(1, 5))
    n = int(rate * random.uniform(15, 40) / runs)
    t = np.arange(n) / rate
    parts = [motion(random, d, t) for _ in range(runs)]
    q, qd, qdd = map(np.concatenate, zip(*parts, strict=True))
    tau = np.asarray(arm.torques(q, qd, qdd))
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
    if repeats:
        arrays = repeat_rows(arrays, random)
    return Simulated(arm.robot, arrays, (qd, qdd), repeats)


def repeat_rows(arrays: Arrays, random: np.random.Generator) -> Arrays:
    """One row in fifty to two hundred holds the values of the one before."""
    rows = np.arange(7, len(arrays["t"]) - 7, int(random.integers(50, 200)))
    changed = {key: arrays[key].copy() for key in ("q", "tau")}
    for values in changed.values():
        values[rows] = values[rows - 1]
    return {**arrays, **changed}


def _column(array: np.ndarray, joint: int, change: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    array = array.copy()
    array[:, joint] = change(array[:, joint])
    return array


def _swapped(arrays: Arrays, random: np.random.Generator, d: int) -> Arrays:
    order = np.arange(d)
    first, second = random.choice(d, 2, replace=False)
    order[[first, second]] = second, first
    return {**arrays, "tau": arrays["tau"][:, order]}


def _flipped(arrays: Arrays, random: np.random.Generator, d: int) -> Arrays:
    return {**arrays, "tau": _column(arrays["tau"], int(random.integers(d)), np.negative)}


def _late(arrays: Arrays, random: np.random.Generator, d: int) -> Arrays:
    """Torques 5 to 50 ms late, by whole samples."""
    step = float(arrays["t"][1] - arrays["t"][0])
    shift = max(1, round(random.uniform(0.005, 0.05) / step))
    tau = arrays["tau"].copy()
    for index in np.unique(arrays["trajectory"]):
        here = arrays["trajectory"] == index
        tau[here] = np.concatenate([np.repeat(tau[here][:1], shift, 0), tau[here][:-shift]])
    return {**arrays, "tau": tau}


def _spikes(arrays: Arrays, random: np.random.Generator, d: int) -> Arrays:
    tau, joint = arrays["tau"].copy(), int(random.integers(d))
    places = random.choice(np.arange(10, len(tau) - 10), 10, replace=False)
    tau[places, joint] += random.choice([-1, 1], 10) * random.uniform(4, 10, 10) * tau[:, joint].std()
    return {**arrays, "tau": tau}


def _saturated(arrays: Arrays, random: np.random.Generator, d: int) -> Arrays:
    def cut(values: np.ndarray) -> np.ndarray:
        return np.clip(values, *np.quantile(values, random.uniform([0.03, 0.9], [0.1, 0.97])))

    return {**arrays, "tau": _column(arrays["tau"], int(random.integers(d)), cut)}


def _dead(arrays: Arrays, random: np.random.Generator, d: int) -> Arrays:
    return {**arrays, "tau": _column(arrays["tau"], int(random.integers(d)), np.zeros_like)}


FAULTS: Mapping[str, tuple[_Fault, tuple[str, ...], str]] = {
    "swapped-columns": (_swapped, ("order",), ""),
    "flipped-sign": (_flipped, ("torque-sign",), ""),
    "delay": (_late, ("delay",), ""),
    "degrees": (lambda a, r, d: {**a, "q": np.degrees(a["q"])}, ("q-unit",), ""),
    "millinewton-metres": (lambda a, r, d: {**a, "tau": 1000 * a["tau"]}, ("gear",), "robot"),
    "rates-exchanged": (lambda a, r, d: {**a, "qd": a["qdd"], "qdd": a["qd"]}, ("qd-exchanged",), "rates"),
    "repeated-rows": (lambda a, r, d: repeat_rows(a, r), ("repeated",), ""),
    "spikes": (_spikes, ("spikes",), ""),
    "dead-channel": (_dead, ("dead-torque",), ""),
    "saturated-torque": (_saturated, ("saturation-tau",), ""),
    "wrong-sampling-time": (
        lambda a, r, d: {**a, "t": a["t"] * r.choice([0.5, 0.8, 1.25, 2.0])}, ("clock",), "robot"
    ),
    "tilted-base": (lambda a, r, d: a, ("gravity",), "tilted"),
}  # fmt: skip
"""A fault's change of a log, the findings that name it, and the inputs beyond t, q and tau."""


def sound(few: bool, *, with_robot: bool) -> Findings:
    """The share of sound logs with a false finding."""
    count, name = QUICK if few else SOUND, "with-robot" if with_robot else "without-robot"
    alarms = []
    for number in range(count):
        log = drawn(number, repeats=number % 2 == 1)
        alarms.append(bool(false_findings(log, log.robot if with_robot else None)))
    words = f"of {count} sound logs with a false error or warning; every other log repeats rows"
    return Findings([expect(f"log-checks/sound-{name}", "false_alarms", words, np.mean(alarms), FALSE_ALARMS)])


def faulty(few: bool, *, kind: str) -> Findings:
    """The share of faulty logs whose fault is detected and named."""
    count, detected = 1 if few else FAULTY, []
    fault, checks, inputs = FAULTS[kind]
    for number in range(count):
        log = drawn(1000 + 100 * list(FAULTS).index(kind) + number, repeats=False)
        detected.append(any(finding in checks for finding in planted(log, fault, inputs, number)))
    words = f"of {count} logs, by {checks[0]}" + (" with the robot" if inputs in ("robot", "tilted") else "")
    return Findings([expect(f"log-checks/{kind}", "found", words, np.mean(detected), FOUND, at_least=True)])


def drawn(number: int, *, repeats: bool) -> Simulated:
    """The log with this number."""
    return simulate(random_arm(SEED + (number // 6) % 2, 2 + number % 6), SEED + number, repeats=repeats)


def false_findings(log: Simulated, robot: Robot | None) -> list[str]:
    """Errors and warnings on a sound log, except statements on how it was recorded."""
    true = (*STATEMENTS, *(("repeated",) if log.repeated else ()))
    return [name for name in _checks(log.arrays, robot) if name not in true]


def planted(log: Simulated, fault: _Fault, inputs: str, seed: int) -> list[str]:
    """Findings in a log with a planted fault."""
    random, d = np.random.default_rng([SEED, seed, 2]), log.arrays["q"].shape[1]
    arrays = dict(log.arrays)
    if inputs == "rates":
        arrays |= {"qd": log.rates[0], "qdd": log.rates[1]}
    robot = log.robot if inputs in ("robot", "tilted") else None
    if inputs == "tilted":
        axis, angle = random.normal(size=3), np.radians(random.uniform(10, 40))
        down = np.asarray(log.robot.tree.gravity, float)
        axis = np.cross(down, axis)
        axis /= np.linalg.norm(axis)
        turned = np.cos(angle) * down + np.sin(angle) * np.cross(axis, down)
        robot = log.robot._replace(tree=log.robot.tree._replace(gravity=turned))
    return _checks(fault(arrays, random, d), robot)


def _checks(arrays: Arrays, robot: Robot | None) -> list[str]:
    return [finding.check for finding in quick(schema.from_arrays(arrays), robot) if finding.severity != "note"]
