"""Coverage of 95 % bands on motions unseen by fit and calibration, and flags of out-of-distribution states."""

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.compilation import quick_compilation
from dln_jax.data.encoders import smooth
from dln_jax.data.schema import Trajectories, load
from dln_jax.data.splits import in_blocks, select, with_joints
from dln_jax.data.splits import split as split_by_labels
from dln_jax.learning import dynamics as problems
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import GaussNewton
from dln_jax.learning.linear import fit_linear
from dln_jax.learning.uncertainty import Estimate, estimate
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees import Tree, dh_frames, inertial_parameters, serial
from dln_jax.metrics.coverage import LEVEL, coverage
from dln_jax.models.lagrangian import make_delan
from dln_jax.models.model import Model, Parameters
from dln_jax.models.rigid_tree import make_rigid_tree
from dln_jax.models.uncertainty import out_of_distribution, predictive
from dln_jax.precision import in_float64
from dln_jax.scenes.datasets.generators import characters, uniform
from dln_jax.scenes.pendulums import two_link_arm
from scripts.reports.case import Case, Findings
from scripts.reports.parts import partition_labels
from scripts.reports.rows import Row
from scripts.reports.uncertainty.arms import VELOCITY_SCALE, arm, motions, plant

LOWEST, HIGHEST = 0.90, 0.98
"""Bounds on the coverage."""
NEGLIGIBLE = 1e-12
TRIM, BLOCK = 0.5, 2.0
"""Time left out at both ends of a recording, and length of a block that counts as a trajectory, s."""
RIGHT = np.pi / 2
UR10 = (
    *((0, 0, 0.1273, 0), (RIGHT, 0, 0, 0), (0, -0.612, 0, 0)),
    *((0, -0.5723, 0.163941, 0), (RIGHT, 0, 0.1157, 0), (-RIGHT, 0, 0.0922, 0)),
)
"""Denavit-Hartenberg rows of the manufacturer, modified: alpha, a, d, theta; rad and m."""
UR10_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")


class HeldOut(NamedTuple):
    """Results of one split on its test motions, and on far states (NaN if there are none)."""

    coverage: np.ndarray
    """Share of test torques inside the bands, by joint [d]."""
    flagged: float
    """Share of test states that are flagged as out of distribution."""
    far_flagged: float = np.nan
    """Share of far states that are flagged."""
    far_coverage: float = np.nan


def judged(
    model: Model, parameters: Parameters, known: Estimate, test: Trajectories, far: Trajectories | None = None
) -> HeldOut:
    """Judges a model's bands and flags on held-out data."""
    answer, results = _answer(model), []
    for data in (test, far) if far is not None else (test,):
        tau, sd, flags = answer(parameters, known.uncertainty, data.q, data.qd, data.qdd)
        results.append((coverage(tau - data.tau, sd, levels=(LEVEL,)).shares[0], float(flags.mean())))
    (shares, flagged), *away = results
    return HeldOut(shares, flagged, *((away[0][1], float(away[0][0].mean())) if away else ()))


@lru_cache(maxsize=2)
def _answer(model: Model) -> Callable[..., Any]:
    """Torque, its standard deviation, and the flag, of many states; one program for all splits."""

    def one(parameters, known, *state):
        std = predictive(model, parameters, known.factor, known.noise, known.inflation)
        tau = dynamics(model.energies(parameters)).inverse_dynamics(*state)
        return tau, std(*state), out_of_distribution(model, parameters, known)(*state)

    many = jax.jit(jax.vmap(one, in_axes=(None, None, 0, 0, 0)), compiler_options=quick_compilation())

    def answer(parameters, known, *states):
        """Evaluates in chunks of one size, so that tests of any size share one program."""
        samples, parts = len(states[0]), []
        for first in range(0, samples, 256):
            rows = np.minimum(np.arange(first, first + 256), samples - 1)
            parts.append(many(parameters, known, *(array[rows] for array in states)))
        return tuple(np.concatenate(arrays)[:samples] for arrays in zip(*parts, strict=True))

    return answer


def rows_of(name: str, splits: Sequence[HeldOut]) -> list[Row]:
    """Medians over splits of the joints with the lowest and the highest coverage, the worst of all, and flags."""
    shares = np.array([split.coverage for split in splits])
    medians = np.median(shares, axis=0)
    expected = f"{LOWEST:.0%} to {HIGHEST:.0%} of held-out torques within bands of 95 %, median over splits"
    rows = [
        Row(name, "coverage_95_lowest_joint", float(medians.min()), bound=LOWEST, at_least=True, expected=expected),
        Row(name, "coverage_95_highest_joint", float(medians.max()), bound=HIGHEST, expected=expected),
        Row(name, "coverage_95_lowest_split", float(shares.min())),
        Row(name, "coverage_95_highest_split", float(shares.max())),
        Row(name, "out_of_distribution_share", float(np.median([split.flagged for split in splits]))),
    ]
    if np.isfinite(splits[0].far_flagged):
        rows.append(
            Row(name, "far_out_of_distribution_share", float(np.median([split.far_flagged for split in splits])))
        )
        rows.append(Row(name, "far_coverage_95", float(np.median([split.far_coverage for split in splits]))))
    return rows


@in_float64
def simulated_arm(name: str, d: int, *, noise: float, unmodelled: bool, splits: int) -> Findings:
    """A rigid tree with friction, fitted to 9 motions of 6 s, calibrated on 2, judged on 3; new ones for each split."""
    tree = arm(d)
    model = make_rigid_tree(tree, friction=True, velocity_scale=VELOCITY_SCALE)
    torque, results = plant(tree, unmodelled=unmodelled), []
    for seed in range(splits):
        drawn = partial(motions, torque, d, 14, noise=noise)
        data, far = drawn(seed=2 * seed), drawn(seed=2 * seed + 1, reach=2.0, speed=2.0)
        train, validation, test = (select(data, part) for part in (range(9), range(9, 11), range(11, 14)))
        results.append(_linear(model, train, validation, test, far))
    return Findings(rows_of(name, results))


@in_float64
def letters(name: str, *, noise: float, splits: int, width: int, steps: int) -> Findings:
    """A structured network of the two-link arm, trained by Gauss-Newton; each letter is a test once, in turn.

    Far are random states over the whole circle. `noise` is a share of each torque's standard deviation.
    """
    data, scene, results = characters(), two_link_arm(), []
    far = uniform(scene, samples=500, seed=1)
    model = make_delan(scene.needs, width=width, depth=2, dtype=jnp.float64)
    for seed, labels in enumerate(partition_labels(data, 7, seed=1)[:splits]):
        random = np.random.default_rng(seed)
        noisy = data._replace(tau=data.tau + noise * data.tau.std(axis=0) * random.normal(size=data.tau.shape))
        sets = split_by_labels(noisy, test=labels, seed=seed)
        parameters = fit(problems.problem(model, sets, seeds=seed), GaussNewton(steps=steps)).parameters
        known = estimate(model, parameters, sets.train, sets.validation)
        results.append(judged(model, parameters, known, sets.test, far))
    return Findings(rows_of(name, results))


@in_float64
def recording(name: str, model: Model, data: Trajectories, *, splits: int) -> Findings:
    """A rigid tree on a real recording: a fifth of its blocks or trajectories is the test, two more calibrate."""
    results = []
    for seed, labels in enumerate(partition_labels(data, 5, seed=0)[:splits]):
        sets = split_by_labels(data, test=labels, validation_share=0.2, seed=seed)
        results.append(_linear(model, sets.train, sets.validation, sets.test))
    return Findings(rows_of(name, results))


def ur10(path: Path) -> tuple[Model, Trajectories]:
    """The recording of an UR10 in blocks of 2 s, filtered at 8 Hz, and the rigid tree of its frames."""
    data = with_joints(load(path), tuple(f"{joint}_joint" for joint in UR10_JOINTS))
    data = smooth(data, 8.0, decimate=2, trim=TRIM).data
    data = in_blocks(data, round((data.t[-1] - data.t[0]) / BLOCK))
    link = inertial_parameters(1.0, np.zeros(3), 0.01 * np.eye(3))
    tree = serial(*dh_frames(UR10), [link] * 6, armature=np.ones(6))
    return make_rigid_tree(tree, friction=True, velocity_scale=0.02), data


def double_pendulum(path: Path) -> tuple[Model, Trajectories]:
    """Recordings of a double pendulum, filtered at 15 Hz, and its rigid tree in a vertical plane."""
    link = inertial_parameters(1.0, np.zeros(3), 0.01 * np.eye(3))
    tree: Tree = serial(
        np.stack([np.eye(3)] * 2), np.array([[0, 0, 0], [0.3, 0, 0]]), [link] * 2, armature=np.ones(2) * 1e-2,
        gravity=np.array([9.81, 0, 0]),
    )  # fmt: skip
    model = make_rigid_tree(tree, friction=True, velocity_scale=0.1)
    return model, smooth(load(path), 15.0, decimate=8, trim=TRIM).data


def _linear(model: Model, train: Trajectories, validation: Trajectories, *tests: Trajectories) -> HeldOut:
    parameters = fit_linear(model, train, negligible=NEGLIGIBLE).parameters
    known = estimate(model, parameters, train, validation, ridge=0.0, negligible=NEGLIGIBLE)
    return judged(model, parameters, known, *tests)


def cases(
    *, splits: int, recorded_arm: Path | None = None, recorded_pendulum: Path | None = None, steps: int = 150
) -> list[Case]:
    """All cases; recordings only if their files are given."""
    made: dict[str, Callable[[str], Findings]] = {
        f"rigid-tree-{d}/friction-{what}": partial(simulated_arm, d=d, noise=0.3, unmodelled=lacking, splits=splits)
        for d in (3, 7)
        for what, lacking in (("modelled", False), ("unmodelled", True))
    }
    for what, noise in (("exact", 0.0), ("noisy", 0.01)):
        made[f"structured-delan/letters-{what}"] = partial(letters, noise=noise, splits=splits, width=8, steps=steps)
    recordings = {"ur10": (ur10, recorded_arm), "double-pendulum": (double_pendulum, recorded_pendulum)}
    for what, (read, path) in recordings.items():
        if path is not None:
            made[f"rigid-tree/{what}"] = lambda name, read=read, path=path: recording(name, *read(path), splits=splits)
    return [Case(name, partial(measure, name)) for name, measure in made.items()]
