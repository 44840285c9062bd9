"""Measure whether models know what they do not know: coverage of 95 % bands on held-out motions, and flags.

Rigid trees of simulated arms, with the friction that they have and with friction that they lack; structured networks of
the embedded letters, exact and noisy; and recordings of a real arm and a real double pendulum where they are given.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax import GaussNewton, Model, fit, joint_dissipation, make_delan, tree_system
from dln_jax import load_trajectories as load
from dln_jax.data.encoders.smoothing import smooth
from dln_jax.data.schema import Trajectories, from_arrays
from dln_jax.data.splits import in_blocks, select, split, with_joints
from dln_jax.learning import dynamics as problems
from dln_jax.learning.linear import design, design_chunks, fit_linear
from dln_jax.learning.uncertainty import Estimate, estimate
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees.description import dh_frames, serial
from dln_jax.mechanics.trees.inertia import inertial_parameters
from dln_jax.metrics.errors import LEVEL, coverage
from dln_jax.models.model import Parameters
from dln_jax.models.trees import make_rigid_tree
from dln_jax.precision import quick_compilation
from dln_jax.runs.evaluation import CHUNK, bands
from dln_jax.scenes.datasets.generators import characters, uniform
from dln_jax.scenes.pendulums import two_link_arm
from scripts.reports.arm.data import partition_labels
from scripts.reports.robots.simulated_arms import RIGHT, panda, waves
from scripts.reports.run import AtLeast, Case, Numbers

VELOCITY_SCALE = 0.05
"""Velocity scale of dry friction, rad/s."""
TRIM, BLOCK = 0.5, 2.0
"""Time left out at both ends of a recording, and length of a block that counts as a trajectory, s."""
UR10 = (
    (0, 0, 0.1273, 0),
    (RIGHT, 0, 0, 0),
    (0, -0.612, 0, 0),
    (0, -0.5723, 0.163941, 0),
    (RIGHT, 0, 0.1157, 0),
    (-RIGHT, 0, 0.0922, 0),
)
"""Denavit-Hartenberg rows of the manufacturer, modified: alpha, a, d, theta; rad and m."""
UR10_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
LINK = inertial_parameters(1.0, np.zeros(3), 0.01 * np.eye(3))
"""A link before it is identified."""
Split = list[tuple[np.ndarray, float]]
"""Share of torques inside the bands by joint [d], and share of flagged states: of a test, and perhaps of far states."""


def simulated_arm(*, d: int, unmodelled: bool, splits: int = 5) -> Numbers:
    """The first d joints of a Panda, fitted to 9 motions of 6 s, calibrated on 2, judged on 3; new ones for each split.

    With `unmodelled`, the plant also has friction that grows with the weight on a joint and as it slows down
    (Stribeck). Far motions have twice the amplitude and twice the frequency.
    """
    random, frames = np.random.default_rng(0), panda().tree
    links = [
        inertial_parameters(5.0 / (1 + i / 2), 0.1 * random.normal(size=3), 0.03 * np.diag(random.uniform(0.5, 1.5, 3)))
        for i in range(d)
    ]
    tree = serial(frames.rotations[:d], frames.positions[:d], links, armature=np.full(d, 0.05))
    offset = np.linspace(-0.1, 0.1, d)
    friction = joint_dissipation(np.full(d, 0.2), np.full(d, 0.5), offset, velocity_scale=VELOCITY_SCALE)
    plant = dynamics(tree_system(tree, friction))

    def torque(q, qd, qdd):
        tau = plant.inverse_dynamics(q, qd, qdd)
        if not unmodelled:
            return tau
        weight = plant.decompose(q, 0 * q, 0 * q).gravity
        return tau + jnp.tanh(qd / VELOCITY_SCALE) * (0.3 * jnp.exp(-((qd / 0.3) ** 2)) + 0.03 * jnp.abs(weight))

    program = jax.jit(jax.vmap(torque), compiler_options=quick_compilation())
    model, results = make_rigid_tree(tree, friction=True, velocity_scale=VELOCITY_SCALE), []
    for seed in range(splits):
        data, far = motions(program, d, 2 * seed), motions(program, d, 2 * seed + 1, further=2.0)
        train, validation, test = (select(data, part) for part in (range(9), range(9, 11), range(11, 14)))
        results.append(linear(model, train, validation, test, far))
    return summary(f"rigid-tree-{d}/friction-{'unmodelled' if unmodelled else 'modelled'}", results)


def motions(torque: Callable[..., Any], d: int, seed: int, *, further: float = 1.0, count: int = 14) -> Trajectories:
    """Motions of four sines per joint; noise of 0.3 N m on the first torque falls to 30 % of that at the last joint."""
    random, t = np.random.default_rng(seed), np.arange(0, 6.0, 0.04)
    rate = further * 2 * np.pi * random.uniform(0.05, 0.5, (count, 1, d, 4))
    size = further * random.uniform(0.1, 0.5, (count, 1, d, 4))
    phase = rate * t[:, None, None] + random.uniform(0, 2 * np.pi, (count, 1, d, 4))
    middle = random.uniform(-0.3, 0.3, (count, 1, d))
    q, qd, qdd = waves(size, rate, phase, axis=-1)
    state = {key: x.reshape(-1, d) for key, x in {"q": middle + q, "qd": qd, "qdd": qdd}.items()}
    tau = np.asarray(torque(*state.values()))
    tau = tau + 0.3 * np.linspace(1, 0.3, d) * random.normal(size=tau.shape)
    trajectory = np.repeat(np.arange(count), len(t))
    return from_arrays({"t": np.tile(t, count), "tau": tau, "trajectory": trajectory, **state})


def letters(*, noise: float, splits: int = 5, steps: int = 150) -> Numbers:
    """A structured network of the two-link arm, trained by Gauss-Newton; each letter is a test once, in turn.

    Far are random states over the whole circle. `noise` is a share of each torque's standard deviation.
    """
    data, scene, results = characters(), two_link_arm(), []
    far = uniform(scene, samples=500, seed=1)
    model = make_delan(scene.needs, width=8, depth=2, dtype=jnp.float64)
    for seed, labels in enumerate(partition_labels(data, 7, seed=1)[:splits]):
        random = np.random.default_rng(seed)
        noisy = data._replace(tau=data.tau + noise * data.tau.std(axis=0) * random.normal(size=data.tau.shape))
        sets = split(noisy, test=labels, seed=seed)
        parameters = fit(problems.problem(model, sets, seeds=seed), GaussNewton(steps=steps)).parameters
        known = estimate(model, parameters, sets.train, sets.validation)
        results.append(judged(model, parameters, known, sets.test, far))
    return summary(f"structured-delan/letters-{'noisy' if noise else 'exact'}", results)


def ur10(*, ur10: Path | None = None, splits: int = 5) -> Numbers:
    """The recording of an UR10 in blocks of 2 s, filtered at 8 Hz, and the rigid tree of its frames."""
    if ur10 is None:
        return {}
    data = with_joints(load(ur10), tuple(f"{joint}_joint" for joint in UR10_JOINTS))
    data = smooth(data, 8.0, decimate=2, trim=TRIM).data
    data = in_blocks(data, round((data.t[-1] - data.t[0]) / BLOCK))
    tree = serial(*dh_frames(UR10), [LINK] * 6, armature=np.ones(6))
    return recording("rigid-tree/ur10", make_rigid_tree(tree, friction=True, velocity_scale=0.02), data, splits)


def double_pendulum(*, double_pendulum: Path | None = None, splits: int = 5) -> Numbers:
    """Recordings of a double pendulum, filtered at 15 Hz, and its rigid tree in a vertical plane."""
    if double_pendulum is None:
        return {}
    places, down = np.array([[0, 0, 0], [0.3, 0, 0]]), np.array([9.81, 0, 0])
    tree = serial(np.stack([np.eye(3)] * 2), places, [LINK] * 2, armature=np.full(2, 1e-2), gravity=down)
    data = smooth(load(double_pendulum), 15.0, decimate=8, trim=TRIM).data
    model = make_rigid_tree(tree, friction=True, velocity_scale=0.1)
    return recording("rigid-tree/double-pendulum", model, data, splits)


def recording(name: str, model: Model, data: Trajectories, splits: int) -> Numbers:
    """A rigid tree on a real recording: a fifth of its blocks or trajectories is the test, two more calibrate."""
    results = []
    for seed, labels in enumerate(partition_labels(data, 5)[:splits]):
        results.append(linear(model, *split(data, test=labels, validation_share=0.2, seed=seed)))
    return summary(name, results)


def linear(model: Model, train: Trajectories, validation: Trajectories, *tests: Trajectories) -> Split:
    """Fits and calibrates a model that is linear in its parameters."""
    parameters = fit_linear(model, train, negligible=1e-12).parameters
    known = estimate(model, parameters, train, validation, ridge=0.0, negligible=1e-12)
    return judged(model, parameters, known, *tests)


def judged(model: Model, parameters: Parameters, known: Estimate, *tests: Trajectories) -> Split:
    """Judges a model's bands and flags on held-out data."""
    results = []
    for data in tests:
        chunks = design_chunks(design(model), parameters, data, CHUNK, even=False)
        error = np.concatenate([predicted - measured for _, predicted, measured in chunks])
        std, flags = bands(model, parameters, known.uncertainty, data)
        results.append((coverage(error, std, levels=(LEVEL,))[0], float(flags.mean())))
    return results


def summary(name: str, splits: Sequence[Split]) -> Numbers:
    """Medians over splits of the joints with the lowest and the highest coverage, the worst of all, and flags."""
    shares = np.array([split[0][0] for split in splits])
    joints = np.median(shares, axis=0)
    numbers = {
        "coverage_95_lowest_joint": joints.min(),
        "coverage_95_highest_joint": joints.max(),
        "coverage_95_lowest_split": shares.min(),
        "coverage_95_highest_split": shares.max(),
        "out_of_distribution_share": np.median([split[0][1] for split in splits]),
    }
    if len(splits[0]) > 1:
        numbers["far_out_of_distribution_share"] = np.median([split[1][1] for split in splits])
        numbers["far_coverage_95"] = np.median([split[1][0].mean() for split in splits])
    return {name: numbers}


BOUND = {"coverage_95_lowest_joint": AtLeast(0.90), "coverage_95_highest_joint": 0.98}
FEW = {"splits": 1}
CASES = (
    *(
        Case(
            f"rigid-tree-{d}/friction-{'unmodelled' if unmodelled else 'modelled'}",
            simulated_arm,
            {"d": d, "unmodelled": unmodelled},
            FEW,
            bound=BOUND,
        )
        for d in (3, 7)
        for unmodelled in (False, True)
    ),
    *(
        Case(f"structured-delan/letters-{name}", letters, {"noise": noise}, {**FEW, "steps": 20}, bound=BOUND)
        for name, noise in (("exact", 0.0), ("noisy", 0.01))
    ),
    Case("rigid-tree/ur10", ur10, quick=FEW, bound=BOUND),
    Case("rigid-tree/double-pendulum", double_pendulum, quick=FEW, bound=BOUND),
)
