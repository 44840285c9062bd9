"""Logs of other kinds of robots and recordings than `log_checks` draws, for the false alarms and misses of the checks.

Robots: a UR5, a SCARA, a wall-mounted six-axis arm with a small wrist, a leg, gimbals with a flywheel and a charged
particle. The first four have a file, which lacks rotors and friction and is off by 10 % in every body. Recordings:
shaken, point to point, at 20 Hz, with 12-bit encoders and torques in steps, with torques that hold no gravity, and with
angles that wrap.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from dln_jax.compilation import quick_compilation
from dln_jax.data import schema
from dln_jax.data.checks import Finding, quick
from dln_jax.data.robots import Robot
from dln_jax.mechanics import trees
from scripts.reports.case import Findings
from scripts.reports.robots.log_checks import FALSE_ALARMS, FOUND, Arrays, motion
from scripts.reports.rows import expect

SEED = 40_000
"""First seed of the reported logs; thresholds were chosen on other seeds."""
EACH, FAULTY, QUICK = 3, 10, 1
"""Sound logs of every robot and recording, and logs of every fault; the last one in a quick run."""
SECONDS, RUNS = 12.0, 2
RIGHT = np.pi / 2
NO_FILE = ("gimbals", "particle")


class Kind(NamedTuple):
    """A robot: its structure, and sizes of its motions and rotors."""

    tree: trees.Tree
    reach: np.ndarray
    """Scale of every joint's motion, rad or m per rad of `log_checks.motion`."""
    rotors: np.ndarray
    """Largest rotor inertias seen at the joints, kg m² or kg."""
    field: np.ndarray | None = None
    """A [d, d], antisymmetric: forces A qd, N m s or N s/m."""


class Recorded(NamedTuple):
    """A log and its robot's file."""

    arrays: Arrays
    robot: Robot | None
    kind: str


def _body(mass: float, centre: Any, size: float) -> np.ndarray:
    return np.asarray(trees.inertial_parameters(mass, np.array(centre), mass * size**2 * np.diag([1.0, 1.2, 0.8])))


@functools.cache
def kinds() -> dict[str, Kind]:
    """Robots by name."""
    ur5 = [[0, 0, 0.089, 0], [RIGHT, 0, 0, 0], [0, -0.425, 0, 0], [0, -0.392, 0.109, 0], [RIGHT, 0, 0.095, 0],
           [-RIGHT, 0, 0.082, 0]]  # fmt: skip
    of_ur5 = [_body(3.7, [0, -0.02, 0], 0.05), _body(8.4, [-0.21, 0, 0.11], 0.13), _body(2.3, [-0.2, 0, 0.02], 0.1),
              _body(1.2, [0, -0.02, 0.01], 0.04), _body(1.2, [0, 0.02, 0.01], 0.04),
              _body(0.3, [0, 0.01, -0.02], 0.03)]  # fmt: skip
    scara = [[0, 0, 0.3, 0], [0, 0.3, 0, 0], [0, 0.25, 0, 0], [0, 0, 0, 0]]
    of_scara = [_body(5, [0.15, 0, 0], 0.1), _body(3, [0.12, 0, 0.05], 0.08), _body(0.8, [0, 0, 0.05], 0.08),
                _body(0.4, [0.02, 0.01, 0], 0.04)]  # fmt: skip
    wall = [[0, 0, 0.3, 0], [RIGHT, 0.05, 0, 0], [0, 0.35, 0, 0], [RIGHT, 0.03, 0.35, 0], [-RIGHT, 0, 0, 0],
            [RIGHT, 0, 0.06, 0]]  # fmt: skip
    of_wall = [_body(6, [0, 0.02, -0.05], 0.08), _body(5, [0.16, 0, 0.05], 0.12), _body(3, [0.02, 0.05, 0.03], 0.07),
               _body(1.5, [0, 0, -0.1], 0.06), _body(0.3, [0, 0.02, 0.01], 0.02),
               _body(0.05, [0, 0.01, 0], 0.01)]  # fmt: skip
    leg = [[RIGHT, 0, 0, 0], [RIGHT, 0, 0.08, -RIGHT], [0, 0.21, 0, 0]]
    of_leg = [_body(0.7, [0, 0, 0.01], 0.03), _body(1.0, [0.05, 0, -0.02], 0.06), _body(0.15, [0.1, 0, 0], 0.06)]
    gimbals = [[0, 0, 0, 0], [RIGHT, 0, 0, 0]]
    of_gimbals = [_body(0.5, [0, 0, 0], 0.3), _body(0.8, [0.1, 0.05, 0], 0.3)]
    slides = [np.eye(3), np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])]
    particle = trees.make_tree(
        [-1, 0], ["prismatic"] * 2, slides, np.zeros((2, 3)), [[0, 0, 1]] * 2,
        [_body(0.01, [0, 0, 0], 0.01), _body(1, [0, 0, 0], 0.1)], gravity=(0.0, 0.0, 0.0),
    )  # fmt: skip
    turning = np.array([[0.0, 1.0], [-1.0, 0.0]])

    def chain(rows: Any, bodies: list[np.ndarray], **more: Any) -> trees.Tree:
        return trees.serial(*trees.dh_frames(rows), bodies, **more)

    rrpr = ["revolute", "revolute", "prismatic", "revolute"]
    return {
        "ur5": Kind(chain(ur5, of_ur5), np.ones(6), np.array([0.8, 0.8, 0.8, 0.15, 0.15, 0.15])),
        "scara": Kind(chain(scara, of_scara, joints=rrpr), np.array([1, 1, 0.1, 1.5]), np.array([0.1, 0.1, 1, 0.01])),
        "wall": Kind(
            chain(wall, of_wall, gravity=(9.81, 0.0, 0.0)), np.ones(6), np.array([0.8, 0.8, 0.4, 0.05, 0.04, 0.02])
        ),
        "leg": Kind(chain(leg, of_leg), np.array([0.4, 1, 1]), np.array([0.01, 0.01, 0.02])),
        "gimbals": Kind(chain(gimbals, of_gimbals), np.ones(2), np.zeros(2), 4.0 * turning),
        "particle": Kind(particle, 0.5 * np.ones(2), np.zeros(2), 3.0 * turning),
    }


def point_to_point(random: np.random.Generator, d: int, t: np.ndarray) -> list[np.ndarray]:
    """q, qd and qdd [n, d]: quintic moves of all joints at a time between random points, with pauses."""
    total = [np.zeros((len(t), d)) for _ in range(3)]
    now, at = random.uniform(-1.2, 1.2, d), 0.0
    while at < t[-1]:
        goal, length = random.uniform(-1.2, 1.2, d), random.uniform(0.7, 1.5)
        x = np.clip((t - at) / length, 0, 1)[:, None]
        here = (t >= at)[:, None]
        step = goal - now
        total[0] = np.where(here, now + step * x**3 * (10 - 15 * x + 6 * x**2), total[0])
        total[1] = np.where(here, step / length * 30 * x**2 * (1 - x) ** 2, total[1])
        total[2] = np.where(here, step / length**2 * 60 * x * (1 - x) * (1 - 2 * x), total[2])
        now, at = goal, at + length + random.uniform(0.1, 0.5)
    return total


@functools.cache
def _torques(name: str) -> Callable[..., Any]:
    tree = kinds()[name].tree

    def one(inertias: Any, armature: Any, gravity: Any, q: Any, qd: Any, qdd: Any) -> Any:
        changed = tree._replace(inertias=inertias, armature=armature, gravity=gravity)
        return trees.newton_euler(changed, q, qd, qdd)

    return jax.jit(jax.vmap(one, in_axes=(None,) * 3 + (0,) * 3), compiler_options=quick_compilation())


RECORDINGS = ("shaken", "point-to-point", "20-hz", "12-bit", "gravity-free", "wraps")
WEIGHTY = ("ur5", "wall", "leg")
"""Robots whose gravity is not a constant torque of friction's offset."""


def record(name: str, recording: str, seed: int) -> Recorded:
    """A log of a robot; every body of the file is off by about 10 %, and the file lacks rotors and friction."""
    random, kind = np.random.default_rng([SEED, seed]), kinds()[name]
    tree, d = kind.tree, len(kind.reach)
    rate = 20.0 if recording == "20-hz" else float(random.choice([100, 125, 250]))
    seconds = 3 * SECONDS if recording == "20-hz" else SECONDS
    t = np.arange(int(seconds * rate)) / rate
    move = point_to_point if recording == "point-to-point" else motion
    pace = 0.5 if recording == "20-hz" else 1.0  # fast motions are not recorded so slowly
    parts = [move(random, d, pace * t) for _ in range(RUNS)]
    q, qd, qdd = (pace**k * np.concatenate(x) * kind.reach for k, x in enumerate(zip(*parts, strict=True)))
    if recording == "wraps":
        q = q + np.where(random.random(d) < 0.7, np.pi, 0.0) * (np.array(tree.joints) == "revolute")
    true = np.asarray(tree.inertias) * random.uniform(0.9, 1.1, (d, 1))
    gravity = np.zeros(3) if recording == "gravity-free" else np.asarray(tree.gravity)
    tau = np.asarray(_torques(name)(true, kind.rotors * random.uniform(0.2, 1.0, d), gravity, q, qd, qdd))
    if kind.field is not None:
        tau = tau + random.uniform(0.3, 1.5) * qd @ kind.field.T
        tau = tau + (0.5 * q if name == "particle" else 0.0)
    size = np.maximum(tau.std(axis=0), 1e-2 * tau.std(axis=0).max())
    if name not in NO_FILE:
        tau = tau + random.uniform(0.05, 0.3, d) * size * np.tanh(qd / qd.std(axis=0) / 0.03)
        tau = tau + random.uniform(0.02, 0.3, d) * size * qd / qd.std(axis=0) + 0.05 * size * random.normal(size=d)
    tau = tau + random.uniform(0.002, 0.03, d) * size * random.normal(size=tau.shape)
    q = q + 10 ** random.uniform(-5.5, -4) * random.normal(size=q.shape)
    if recording == "12-bit":
        step = 2 * np.pi / 4096 * np.where(np.array(tree.joints) == "revolute", 1.0, 0.01)
        q, steps = np.round(q / step) * step, np.minimum(0.5, 0.1 * size)
        tau = np.round(tau / steps) * steps
    if recording == "wraps":
        turning = np.array(tree.joints) == "revolute"
        q = np.where(turning, (q + np.pi) % (2 * np.pi) - np.pi, q)
    arrays = {"t": np.tile(t, RUNS), "q": q, "tau": tau, "trajectory": np.repeat(np.arange(RUNS), len(t))}
    if random.random() < 0.5:
        arrays["qd"] = qd + 1e-3 * qd.std(axis=0) * random.normal(size=qd.shape)
    wide = np.tile([-np.inf, np.inf], (d, 1))
    robot = None if name in NO_FILE else Robot(tree, np.zeros(d), np.zeros(d), wide, wide)
    return Recorded(arrays, robot, name)


def checked(log: Recorded, arrays: Arrays) -> list[Finding]:
    """Errors and warnings of the checks, with the robot's file where there is one."""
    return [finding for finding in quick(schema.from_arrays(arrays), log.robot) if finding.severity != "note"]


def sound(few: bool, *, recording: str) -> Findings:
    """The share of sound logs of one kind of recording, over all robots, with a false error."""
    count = QUICK if few else EACH
    logs = [record(name, recording, 100 * number) for name in kinds() for number in range(count)]
    alarms = [any(finding.severity == "error" for finding in checked(log, log.arrays)) for log in logs]
    words = f"{sum(alarms)} of {len(logs)} sound logs of {len(kinds())} robots with a false error"
    return Findings(
        [expect(f"log-checks/other-robots/{recording}", "false_errors", words, np.mean(alarms), FALSE_ALARMS)]
    )


def turned(arrays: Arrays, joints: slice) -> Arrays:
    """The log with torques of some joints reversed."""
    tau = arrays["tau"].copy()
    tau[:, joints] *= -1
    return {**arrays, "tau": tau}


def late(arrays: Arrays) -> Arrays:
    """The log with torques 200 ms late."""
    tau, shift = arrays["tau"].copy(), round(0.2 / float(arrays["t"][1] - arrays["t"][0]))
    for index in np.unique(arrays["trajectory"]):
        here = arrays["trajectory"] == index
        tau[here] = np.concatenate([np.repeat(tau[here][:1], shift, 0), tau[here][:-shift]])
    return {**arrays, "tau": tau}


def _all_reversed(log: Recorded) -> bool:
    findings = checked(log, turned(log.arrays, slice(None)))
    return any(f.check == "tree-sign" and len(f.joints) == log.arrays["q"].shape[1] for f in findings)


def _second_reversed(log: Recorded) -> bool:
    """Joint 2 alone is blamed, and nothing is left after the repair."""
    faulty = turned(log.arrays, slice(1, 2))
    blamed = [finding.joints for finding in checked(log, faulty) if finding.severity == "error"]
    repaired = checked(log, turned(faulty, slice(1, 2)))
    return blamed == [(1,)] and not any(finding.severity == "error" for finding in repaired)


def _late(log: Recorded) -> bool:
    return any(finding.check == "delay" and "late" in finding.observation for finding in checked(log, late(log.arrays)))


def _gravity_free(log: Recorded) -> bool:
    return [f.check for f in checked(log, log.arrays) if f.check in ("no-gravity", "gravity", "clock")] == [
        "no-gravity"
    ]


def _wraps(log: Recorded) -> bool:
    """Jumps are removed and said, and the log has no error."""
    data = schema.from_arrays(log.arrays)
    jumps = np.abs(np.diff(log.arrays["q"], axis=0))[np.diff(data.trajectory) == 0].max() > np.pi
    smooth = np.abs(np.diff(data.q, axis=0))[np.diff(data.trajectory) == 0].max() < np.pi
    remarked = any("wrap by 2 pi" in remark for remark in data.remarks)
    return smooth and remarked == jumps and not any(finding.severity == "error" for finding in checked(log, log.arrays))


FAULTS: Mapping[str, tuple[tuple[str, ...], str, Callable[[Recorded], bool]]] = {
    "all-torques-reversed": (("ur5", "scara", "leg"), "shaken", _all_reversed),
    "scara-second-reversed": (("scara",), "shaken", _second_reversed),
    "200-ms-late-at-20-hz": (("scara", "leg", "gimbals"), "20-hz", _late),
    "gravity-free": (WEIGHTY, "gravity-free", _gravity_free),
    "wraps": (("scara", "leg", "gimbals"), "wraps", _wraps),
}
"""Robots and recording of every fault, and whether it is found and named."""


def faulty(few: bool, *, kind: str) -> Findings:
    """The share of faulty logs whose fault is detected and named."""
    robots, recording, detect = FAULTS[kind]
    count = QUICK if few else FAULTY
    logs = [record(robots[number % len(robots)], recording, 7 + 100 * number) for number in range(count)]
    hits = [detect(log) for log in logs]
    words = f"{sum(hits)} of {count} logs of {', '.join(robots)}"
    return Findings([expect(f"log-checks/{kind}", "found", words, np.mean(hits), FOUND, at_least=True)])
