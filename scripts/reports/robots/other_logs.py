"""Error rates of the log checks on other robots and recordings, and of the detectors of stamps and of repeated motions.

Robots: a UR5, a SCARA, a wall-mounted six-axis arm with a small wrist, a leg, gimbals with a flywheel and a charged
particle. The first four have a file, which lacks rotors and friction and is off by 10 % in every body.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from dln_jax.compilation import quick_compilation
from dln_jax.data import Robot, schema
from dln_jax.data.encoders import source_clock
from dln_jax.data.repeated_motions import motion_numbers
from dln_jax.mechanics import trees
from scripts.reports.robots.log_checks import Arrays, findings, late, motion, quintic, without_friction
from scripts.reports.run import Numbers

SEED, OTHER_SEED = 40_000, 30_000
"""First seeds of the reported logs of other robots, and of other detectors; thresholds were chosen on other seeds."""
RIGHT = np.pi / 2
NO_FILE = ("gimbals", "particle")
RECORDINGS = ("shaken", "point-to-point", "20-hz", "12-bit", "gravity-free", "wraps")
TURNING = np.array([[0.0, 1.0], [-1.0, 0.0]])
CHAINS = {  # Denavit-Hartenberg rows; mass, centre and size of bodies; reach of joints; rotors; options of the tree
    "ur5": (
        [[0, 0, 0.089, 0], [RIGHT, 0, 0, 0], [0, -0.425, 0, 0], [0, -0.392, 0.109, 0], [RIGHT, 0, 0.095, 0],
         [-RIGHT, 0, 0.082, 0]],
        [(3.7, [0, -0.02, 0], 0.05), (8.4, [-0.21, 0, 0.11], 0.13), (2.3, [-0.2, 0, 0.02], 0.1),
         (1.2, [0, -0.02, 0.01], 0.04), (1.2, [0, 0.02, 0.01], 0.04), (0.3, [0, 0.01, -0.02], 0.03)],
        [1] * 6, [0.8, 0.8, 0.8, 0.15, 0.15, 0.15], {},
    ),
    "scara": (
        [[0, 0, 0.3, 0], [0, 0.3, 0, 0], [0, 0.25, 0, 0], [0, 0, 0, 0]],
        [(5, [0.15, 0, 0], 0.1), (3, [0.12, 0, 0.05], 0.08), (0.8, [0, 0, 0.05], 0.08), (0.4, [0.02, 0.01, 0], 0.04)],
        [1, 1, 0.1, 1.5], [0.1, 0.1, 1, 0.01], {"joints": ["revolute", "revolute", "prismatic", "revolute"]},
    ),
    "wall": (
        [[0, 0, 0.3, 0], [RIGHT, 0.05, 0, 0], [0, 0.35, 0, 0], [RIGHT, 0.03, 0.35, 0], [-RIGHT, 0, 0, 0],
         [RIGHT, 0, 0.06, 0]],
        [(6, [0, 0.02, -0.05], 0.08), (5, [0.16, 0, 0.05], 0.12), (3, [0.02, 0.05, 0.03], 0.07),
         (1.5, [0, 0, -0.1], 0.06), (0.3, [0, 0.02, 0.01], 0.02), (0.05, [0, 0.01, 0], 0.01)],
        [1] * 6, [0.8, 0.8, 0.4, 0.05, 0.04, 0.02], {"gravity": (9.81, 0.0, 0.0)},
    ),
    "leg": (
        [[RIGHT, 0, 0, 0], [RIGHT, 0, 0.08, -RIGHT], [0, 0.21, 0, 0]],
        [(0.7, [0, 0, 0.01], 0.03), (1.0, [0.05, 0, -0.02], 0.06), (0.15, [0.1, 0, 0], 0.06)],
        [0.4, 1, 1], [0.01, 0.01, 0.02], {},
    ),
    "gimbals": (
        [[0, 0, 0, 0], [RIGHT, 0, 0, 0]], [(0.5, [0, 0, 0], 0.3), (0.8, [0.1, 0.05, 0], 0.3)], [1] * 2, [0, 0], {},
    ),
}  # fmt: skip
FIELDS = {"gimbals": 4.0 * TURNING, "particle": 3.0 * TURNING}
"""A [d, d], antisymmetric, of forces A qd, N m s or N s/m."""


class Kind(NamedTuple):
    """A robot: its structure, sizes of its motions, largest rotor inertias at the joints, and its torques."""

    tree: trees.Tree
    reach: np.ndarray
    rotors: np.ndarray
    torques: Callable[..., Any]


@functools.cache
def kind_of(name: str) -> Kind:
    """A robot by name; robots are cached because their programs take long to compile."""

    def body(mass: float, centre: Any, size: float) -> np.ndarray:
        moments = mass * size**2 * np.diag([1.0, 1.2, 0.8])
        return np.asarray(trees.inertial_parameters(mass, np.array(centre), moments))

    if name == "particle":
        slides = [np.eye(3), np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])]
        bodies = [body(0.01, [0, 0, 0], 0.01), body(1, [0, 0, 0], 0.1)]
        tree = trees.make_tree(
            [-1, 0], ["prismatic"] * 2, slides, np.zeros((2, 3)), [[0, 0, 1]] * 2, bodies, gravity=np.zeros(3)
        )
        reach, rotors = [0.5] * 2, [0] * 2
    else:
        rows, bodies, reach, rotors, options = CHAINS[name]
        tree = trees.serial(*trees.dh_frames(rows), [body(*values) for values in bodies], **options)

    def torques(inertias: Any, armature: Any, gravity: Any, *state: Any) -> Any:
        return trees.newton_euler(tree._replace(inertias=inertias, armature=armature, gravity=gravity), *state)

    program = jax.jit(jax.vmap(torques, in_axes=(None,) * 3 + (0,) * 3), compiler_options=quick_compilation())
    return Kind(tree, np.array(reach, float), np.array(rotors, float), program)


def record(name: str, recording: str, seed: int) -> tuple[Arrays, Robot | None]:
    """A log of a robot, and its file; every body of the file is off by about 10 %."""
    random, kind = np.random.default_rng([SEED, seed]), kind_of(name)
    tree, d, runs = kind.tree, len(kind.reach), 2
    slow, turning = recording == "20-hz", np.array(tree.joints) == "revolute"
    rate = 20.0 if slow else float(random.choice([100, 125, 250]))
    t = np.arange(int((36.0 if slow else 12.0) * rate)) / rate
    move = point_to_point if recording == "point-to-point" else motion
    pace = 0.5 if slow else 1.0  # fast motions are not recorded so slowly
    parts = np.concatenate([move(random, d, pace * t) for _ in range(runs)], axis=1)
    q, qd, qdd = (pace**k * x * kind.reach for k, x in enumerate(parts))
    if recording == "wraps":
        q = q + np.where(random.random(d) < 0.7, np.pi, 0.0) * turning
    true = np.asarray(tree.inertias) * random.uniform(0.9, 1.1, (d, 1))
    gravity = np.zeros(3) if recording == "gravity-free" else np.asarray(tree.gravity)
    tau = np.asarray(kind.torques(true, kind.rotors * random.uniform(0.2, 1.0, d), gravity, q, qd, qdd))
    if name in FIELDS:
        tau = tau + random.uniform(0.3, 1.5) * qd @ FIELDS[name].T
        tau = tau + (0.5 * q if name == "particle" else 0.0)
    size = np.maximum(tau.std(axis=0), 1e-2 * tau.std(axis=0).max())
    if name not in NO_FILE:
        tau = tau + random.uniform(0.05, 0.3, d) * size * np.tanh(qd / qd.std(axis=0) / 0.03)
        tau = tau + random.uniform(0.02, 0.3, d) * size * qd / qd.std(axis=0) + 0.05 * size * random.normal(size=d)
    tau = tau + random.uniform(0.002, 0.03, d) * size * random.normal(size=tau.shape)
    q = q + 10 ** random.uniform(-5.5, -4) * random.normal(size=q.shape)
    if recording == "12-bit":
        step, steps = 2 * np.pi / 4096 * np.where(turning, 1.0, 0.01), np.minimum(0.5, 0.1 * size)
        q, tau = np.round(q / step) * step, np.round(tau / steps) * steps
    if recording == "wraps":
        q = np.where(turning, (q + np.pi) % (2 * np.pi) - np.pi, q)
    arrays = {"t": np.tile(t, runs), "q": q, "tau": tau, "trajectory": np.repeat(np.arange(runs), len(t))}
    if random.random() < 0.5:
        arrays["qd"] = qd + 1e-3 * qd.std(axis=0) * random.normal(size=qd.shape)
    return arrays, None if name in NO_FILE else without_friction(tree)


def point_to_point(random: np.random.Generator, d: int, t: np.ndarray) -> np.ndarray:
    """q, qd and qdd [3, n, d]: quintic moves of all joints at a time between random points, with pauses."""
    total = np.zeros((3, len(t), d))
    now, at = random.uniform(-1.2, 1.2, d), 0.0
    while at < t[-1]:
        goal, length = random.uniform(-1.2, 1.2, d), random.uniform(0.7, 1.5)
        x = np.clip((t - at) / length, 0, 1)[:, None]
        total = np.where((t >= at)[:, None], quintic(x, length, now, goal - now), total)
        now, at = goal, at + length + random.uniform(0.1, 0.5)
    return total


def sound(*, logs_of_each: int = 3) -> Numbers:
    """The share of sound logs of a kind of recording, over all robots, with a false error."""
    numbers = {}
    for recording in RECORDINGS:
        logs = [record(name, recording, 100 * k) for name in (*CHAINS, "particle") for k in range(logs_of_each)]
        alarms = [any(errors(*log)) for log in logs]
        numbers[f"log-checks/other-robots/{recording}"] = {"false_errors": np.mean(alarms)}
    return numbers


def faults(*, faulty_logs: int = 10) -> Numbers:
    """The share of faulty logs whose fault is detected and named."""
    kinds = {
        "all-torques-reversed": (all_reversed, ("ur5", "scara", "leg"), "shaken"),
        "scara-second-reversed": (second_reversed, ("scara",), "shaken"),
        "200-ms-late-at-20-hz": (delayed, ("scara", "leg", "gimbals"), "20-hz"),
        "gravity-free": (gravity_free, ("ur5", "wall", "leg"), "gravity-free"),
        "wraps": (wrapped, ("scara", "leg", "gimbals"), "wraps"),
    }
    numbers = {}
    for name, (detects, robots, recording) in kinds.items():
        logs = [record(robots[k % len(robots)], recording, 7 + 100 * k) for k in range(faulty_logs)]
        numbers[f"log-checks/{name}"] = {"found": np.mean([detects(*log) for log in logs])}
    return numbers


def errors(arrays: Arrays, robot: Robot | None) -> list[tuple[int, ...]]:
    """Joints of the errors that the checks find."""
    return [(*finding.joints,) or (-1,) for finding in findings(arrays, robot) if finding.severity == "error"]


def all_reversed(arrays: Arrays, robot: Robot | None) -> bool:
    """All torques reversed are found."""
    outcome = findings({**arrays, "tau": -arrays["tau"]}, robot)
    return any(f.check == "tree-sign" and len(f.joints) == arrays["q"].shape[1] for f in outcome)


def second_reversed(arrays: Arrays, robot: Robot | None) -> bool:
    """Joint 2 alone is blamed, and nothing is left after the repair."""
    turned = {**arrays, "tau": arrays["tau"] * np.where(np.arange(arrays["q"].shape[1]) == 1, -1, 1)}
    return errors(turned, robot) == [(1,)] and not errors(arrays, robot)


def delayed(arrays: Arrays, robot: Robot | None) -> bool:
    """Torques 200 ms late are found."""
    outcome = findings({**arrays, "tau": late(arrays, 0.2)}, robot)
    return any(finding.check == "delay" and "late" in finding.observation for finding in outcome)


def gravity_free(arrays: Arrays, robot: Robot | None) -> bool:
    """Missing gravity is named, and nothing else in its place."""
    named = [finding.check for finding in findings(arrays, robot)]
    return [name for name in named if name in ("no-gravity", "gravity", "clock")] == ["no-gravity"]


def wrapped(arrays: Arrays, robot: Robot | None) -> bool:
    """Jumps are removed and said, and the log has no error."""
    data = schema.from_arrays(arrays)
    inside = np.diff(data.trajectory) == 0
    jumps, left = (np.abs(np.diff(q, axis=0))[inside].max() > np.pi for q in (arrays["q"], data.q))
    remarked = any("wrap by 2 pi" in remark for remark in data.remarks)
    return not left and remarked == jumps and not errors(arrays, robot)


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
        alarms += [source_clock(stamped(random, sines, t, t, noise)) is not None for t in (regular, lost, uneven)]
        stamps = lost + random.exponential(random.uniform(0.1, 0.5) / rate, len(lost))
        stamps = np.maximum.accumulate(stamps) + 1e-9 * np.arange(len(stamps))
        if clock := source_clock(stamped(random, sines, lost, stamps, noise)):
            speed = np.abs(sum_of(sines, lost)[1]).sum(axis=1)
            moving = speed > 0.5 * speed.mean()
            left.append(np.std((clock.t - lost)[moving]) / np.std((stamps - lost)[moving]))
    numbers = {"found": len(left) / stamped_logs, "error_left": max(left, default=np.inf)}
    return {"log-checks/arrival": {**numbers, "false_alarms": np.mean(alarms)}}


def sum_of(sines: Sequence[np.ndarray], t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """q and qd [n, d] of sines with these frequencies, phases and sizes."""
    frequency, phase, size = sines
    angle = 2 * np.pi * np.multiply.outer(t, frequency) + phase
    return np.sum(size * np.sin(angle), axis=1), np.sum(2 * np.pi * frequency * size * np.cos(angle), axis=1)


def stamped(
    random: np.random.Generator, sines: Sequence[np.ndarray], t: np.ndarray, stamps: np.ndarray, noise: float
) -> schema.Trajectories:
    """A log with encoder noise, and 1 % of noise in qd."""
    q, qd = sum_of(sines, t)
    seen = {"q": q + noise * random.normal(size=q.shape), "qd": qd * (1 + 0.01 * random.normal(size=q.shape))}
    return schema.from_arrays({**seen, "tau": 0 * q, "t": stamps, "trajectory": np.zeros(len(q), int)})


def repeated_motions(*, sets: int = 20) -> Numbers:
    """The share of different motions that count as one, and of sets of five motions, each recorded four times."""
    recordings, samples = 20, 400

    def count(motions: list[np.ndarray]) -> int:
        trajectory = np.repeat(np.arange(len(motions)), [len(q) for q in motions])
        return len(np.unique(motion_numbers(np.concatenate(motions), trajectory)))

    def through(points: np.ndarray) -> np.ndarray:
        place = np.linspace(0, len(points) - 1, samples)
        first = np.minimum(place.astype(int), len(points) - 2)
        share = (place - first)[:, None]
        share = share**2 * (3 - 2 * share)
        return points[first] * (1 - share) + points[first + 1] * share

    def fourier(random: np.random.Generator, d: int) -> np.ndarray:
        angles = 2 * np.pi * np.multiply.outer(np.linspace(0, 1, samples), np.arange(1, 6))
        sines, cosines = random.normal(size=(2, 5, d)) / np.arange(1, 6)[:, None]
        return np.sin(angles) @ sines + np.cos(angles) @ cosines

    def swings(random: np.random.Generator, d: int) -> np.ndarray:
        """Small free oscillations: the modes of one body, with random sizes and phases."""
        modes = np.linalg.qr(np.random.default_rng(5).normal(size=(d, d)))[0]
        t, frequency = np.linspace(0, 8, samples), 3.0 + 4.0 * np.arange(d)
        return (random.normal(size=d) * np.cos(np.multiply.outer(t, frequency) + random.uniform(0, 6.3, d))) @ modes

    def again(random: np.random.Generator, q: np.ndarray) -> np.ndarray:
        """A recording of a motion: from a later start, off by 1 % of its size, with noise."""
        part = q[random.integers(0, samples // 20) :]
        return part + 0.01 * q.std(axis=0) * random.normal(size=q.shape[1]) + 1e-3 * random.normal(size=part.shape)

    kinds: tuple[Callable[..., np.ndarray], ...] = (
        fourier,
        lambda random, d: through(random.normal(size=(8, d))),
        lambda random, d: through(np.stack([np.zeros(d), random.normal(size=d), np.zeros(d)])),
        swings,
    )
    joined, outcome = [], []
    for kind, make in enumerate(kinds):
        for d in (2, 3, 7):
            for number in range(sets):
                random = np.random.default_rng([OTHER_SEED, kind, d, number])
                joined.append(1 - count([make(random, d) for _ in range(recordings)]) / recordings)
                repeated = (make(random, d) for _ in range(5))
                outcome.append(count([again(random, q) for q in repeated for _ in range(4)]) <= 5)
    return {"log-checks/repeated-motions": {"wrongly_joined": np.mean(joined), "found": np.mean(outcome)}}
