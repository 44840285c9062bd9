"""Error rates of the log validation: false findings on sound logs, and planted faults that it misses.

Arms have random frames and two to seven joints; some are branched, and one is the Panda. They move from point to point,
wait, and shake. Torques have noise, friction with a Stribeck curve, or neither; encoders have steps and noise. Beside
these stand the error rates of the detectors of stamps of arrival and of repeated motions.
"""

import functools
import itertools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from dln_jax.data import schema
from dln_jax.data.checks.channels import Finding
from dln_jax.data.checks.report import quick
from dln_jax.data.encoders.clock import source_clock
from dln_jax.data.repeated_motions import motion_numbers
from dln_jax.data.robots import Robot
from dln_jax.mechanics.trees.description import make_tree
from dln_jax.mechanics.trees.inertia import inertial_parameters
from dln_jax.mechanics.trees.recursions import newton_euler
from dln_jax.precision import quick_compilation
from scripts.reports.robots.simulated_arms import panda, waves
from scripts.reports.run import Numbers

SEED, OTHER_SEED = 20_000, 30_000
"""First seeds of the reported logs, and of other detectors; thresholds were chosen on other arms, motions and seeds."""
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
    "gravity-free": "no-gravity",
    "all-torques-reversed": "tree-sign",
}
"""Findings that name the faults."""
WITH_ROBOT = ("millinewton-metres", "wrong-sampling-time", "tilted-base", "gravity-free", "all-torques-reversed")
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
            shift = max(1, round(random.uniform(0.005, 0.05) / float(t[1] - t[0])))
            for index in np.unique(arrays["trajectory"]):
                here = arrays["trajectory"] == index
                tau[here] = np.concatenate([np.repeat(tau[here][:1], shift, 0), tau[here][:-shift]])
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
        case "gravity-free":
            weight = jax.vmap(lambda q: newton_euler(robot.tree, q, 0 * q, 0 * q))
            tau -= np.asarray(jax.jit(weight)(q))
        case "all-torques-reversed":
            tau *= -1
    return robot if kind in WITH_ROBOT else None, {**arrays, "t": t, "q": q, "tau": tau, **changed}


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
            inertial_parameters(m, random.uniform(-0.2, 0.2, 3), m * 0.02 * np.diag(random.uniform(1, 2, 3)))
            for m in masses
        ]
        gravity = (9.81, 0.0, 0.0) if seed % 4 == 1 else (0.0, 0.0, -9.81)
        tree = make_tree(
            parents, ["revolute"] * d, turns, positions, [[0, 0, 1]] * d, links,
            armature=random.uniform(0.0, 0.1, d), gravity=gravity,
        )  # fmt: skip
    forces = jax.jit(jax.vmap(lambda *x: newton_euler(tree, *x)), compiler_options=quick_compilation())
    unlimited = np.tile([-np.inf, np.inf], (d, 1))
    return Robot(tree, np.zeros(d), np.zeros(d), unlimited, unlimited), forces


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
        x, step = (t - began) / length, points[place + 1] - points[place]
        total[0, :, joint] = points[place] + step * x**3 * (10 - 15 * x + 6 * x**2)
        total[1, :, joint] = step / length * 30 * x**2 * (1 - x) ** 2
        total[2, :, joint] = step / length**2 * 60 * x * (1 - x) * (1 - 2 * x)
        for _ in range(2):
            w, phase, size = 2 * np.pi * random.uniform(0.4, 2.0), random.uniform(0, 6.3), random.uniform(0.02, 0.12)
            wave = np.stack([np.sin(w * t + phase), w * np.cos(w * t + phase), -(w**2) * np.sin(w * t + phase)])
            total[:, :, joint] += size * wave
    return total


def arrival(*, stamped_logs: int = 60) -> Numbers:
    """Logs of 1 to 7 joints at 60 to 1000 Hz, some rows lost: stamped on time, when measured, or when they arrive.

    `error_left` is the remaining error of the times over the lateness of the stamps in the worst log.
    """
    alarms, left = [], []
    for number in range(stamped_logs):
        random = np.random.default_rng([OTHER_SEED, number])
        rate, d = 10 ** random.uniform(np.log10(60), 3), int(random.integers(1, 8))
        sines = [random.uniform(*ends, (4, d)) for ends in ((0.1, 1.5), (0, 6.3), (0.1, 0.5))]
        regular = np.arange(int(random.uniform(15, 40) * rate)) / rate
        lost = regular[random.random(len(regular)) > random.uniform(0, 0.1)]
        uneven = np.sort(regular + random.uniform(-0.2, 0.2, len(regular)) / rate)
        noise = 10 ** random.uniform(-6, -3.7)

        def log(t, stamps, random=random, sines=sines, noise=noise):
            frequency, phase, size = sines
            w = 2 * np.pi * frequency
            q, qd, _ = waves(size, w, np.multiply.outer(t, w) + phase, axis=1)
            seen = {"q": q + noise * random.normal(size=q.shape), "qd": qd * (1 + 0.01 * random.normal(size=q.shape))}
            return schema.from_arrays({**seen, "tau": 0 * q, "t": stamps, "trajectory": np.zeros(len(q), int)})

        alarms += [source_clock(log(t, t)) is not None for t in (regular, lost, uneven)]
        stamps = lost + random.exponential(random.uniform(0.1, 0.5) / rate, len(lost))
        stamps = np.maximum.accumulate(stamps) + 1e-9 * np.arange(len(stamps))
        late = log(lost, stamps)
        if clock := source_clock(late):
            speed = np.abs(late.qd).sum(axis=1)
            moving = speed > 0.5 * speed.mean()
            left.append(np.std((clock.t - lost)[moving]) / np.std((stamps - lost)[moving]))
    share, worst = len(left) / stamped_logs, max(left, default=np.inf)
    return {"log-checks/arrival": {"found": share, "error_left": worst, "false_alarms": np.mean(alarms)}}


def repeated_motions(*, sets: int = 20) -> Numbers:
    """The share of different motions that count as one, and of sets of five motions, each recorded four times.

    Motions pass through random points, go out and back, or are small swings: modes of one body with random phases.
    """
    recordings, x = 20, np.linspace(0, 1, 400)

    def count(motions):
        trajectory = np.repeat(np.arange(len(motions)), [len(q) for q in motions])
        return len(np.unique(motion_numbers(np.concatenate(motions), trajectory)))

    def swings(random, d):
        modes = np.linalg.qr(np.random.default_rng(5).normal(size=(d, d)))[0]
        angles = np.multiply.outer(8 * x, 3.0 + 4.0 * np.arange(d)) + random.uniform(0, 6.3, d)
        return (random.normal(size=d) * np.cos(angles)) @ modes

    def again(random, q):
        """A recording of a motion: from a later start, off by 1 % of its size, with noise."""
        part = q[random.integers(0, len(q) // 20) :]
        return part + 0.01 * q.std(axis=0) * random.normal(size=q.shape[1]) + 1e-3 * random.normal(size=part.shape)

    kinds: tuple[Callable[..., np.ndarray], ...] = (
        lambda random, d: motion(random, d, 8 * x)[0],
        lambda random, d: np.multiply.outer(np.sin(np.pi * x) ** 2, random.normal(size=d)),
        swings,
    )
    joined, outcome = [], []
    for (kind, make), d, number in itertools.product(enumerate(kinds), (2, 3, 7), range(sets)):
        random = np.random.default_rng([OTHER_SEED, kind, d, number])
        joined.append(1 - count([make(random, d) for _ in range(recordings)]) / recordings)
        repeated = (make(random, d) for _ in range(5))
        outcome.append(count([again(random, q) for q in repeated for _ in range(4)]) <= 5)
    return {"log-checks/repeated-motions": {"wrongly_joined": np.mean(joined), "found": np.mean(outcome)}}
