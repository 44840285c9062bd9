"""The LIP protocol: torques on unseen motions by a learned tree, a kernel and a tree of known kinematics.

One motion of 50 s trains, motions of other seeds test (`simulated_arms`); the torques of the tests are exact, so
that errors may fall below the noise of the training torques.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from dln_jax.compilation import quick_compilation
from dln_jax.data.schema import Trajectories
from dln_jax.learning.kernel import fit_kernel
from dln_jax.learning.kinematics import Search, fit_tree
from dln_jax.learning.linear import fit_linear
from dln_jax.mechanics.closed_form import RecursiveSystem
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.recursive import RecursiveSystem
from dln_jax.models.rigid_tree import make_rigid_tree
from dln_jax.models.serial_tree import make_serial_tree
from dln_jax.precision import in_float64
from dln_jax.types import FrictionLaw
from dln_jax.zoo.catalogue import CATALOGUE
from scripts.reports.rows import Row

ARMS: dict[str, Callable[[], Arm]] = {
    **{f"panda-{d}": (lambda d=d: panda(d)) for d in range(3, 8)},
    "skew-arm": skew_arm,
    "sliding-arm": sliding_arm,
}
VELOCITY_SCALE = 1e-3
"""Velocity scale of the models' dry friction, rad/s or m/s; the arms' own dry friction is discontinuous."""
TESTS = tuple(range(101, 121))
"""Seeds of the test motions."""
TEST_EVERY = 50
"""Stride of the test samples for a kernel, which is slow: two samples per second."""
TARGET = 1e-3
"""Mean nMSE to reach at seven joints from 500 samples."""
PUBLISHED = {"panda-6": 0.03, "panda-7": 0.1}
"""Mean nMSE of the LIP paper's kernel from 500 samples without friction: about 3 %, and below 10 %."""
FRICTION: tuple[FrictionLaw, ...] = ("viscous", "coulomb", "offset")


STATES = 5_001
"""Number of states per call of the inverse dynamics."""


class Outcome(NamedTuple):
    """Result of one fit."""

    nmse: Float[np.ndarray, "T d"]
    """Mean square error over variance of the torque, by test motion and joint."""
    joint_mse: Float[np.ndarray, " d"]
    """Mean squared errors on the training samples, (N m)² or N²."""
    agreeing: int
    """Number of descents that reached the lowest loss; 0 for a linear fit."""
    descents: int
    seconds: float


@in_float64
def learned(arm: Arm, *, friction: bool, every: int = 10, seed: int = 0, tests: Sequence[int] = TESTS) -> Outcome:
    """A tree learned from the motion of seed 0 without its kinematics.

    Args:
        arm: the plant.
        friction: whether that of the arm acts.
        every: samples of 10 ms of which one is kept; 10 leaves 501.
        seed: of the starts.
        tests: seeds of the test motions.
    """
    train = lip_trajectories(arm, friction=friction, every=every)
    needs = arm.tree.needs._replace(friction=friction)
    fit = fit_tree(needs, train, velocity_scale=VELOCITY_SCALE, settings=Search(seed=seed))
    model = make_serial_tree(needs, velocity_scale=VELOCITY_SCALE)
    nmse = unseen_errors(arm, model.energies(fit.parameters), friction=friction, tests=tests)
    return Outcome(nmse, fit.joint_mse, fit.agreeing, len(fit.losses), fit.seconds)


@in_float64
def known(arm: Arm, *, friction: bool, every: int = 10, tests: Sequence[int] = TESTS) -> Outcome:
    """The tree with the arm's own frames, by one linear fit; arguments as for `learned`."""
    train = lip_trajectories(arm, friction=friction, every=every)
    model = make_rigid_tree(arm.tree, friction=friction, velocity_scale=VELOCITY_SCALE)
    fit = fit_linear(model, train, negligible=1e-12)
    system = model.energies(fit.parameters)
    nmse = unseen_errors(arm, system, friction=friction, tests=tests)
    joint_mse = np.mean((torques_of(system, train) - train.tau) ** 2, axis=0)
    return Outcome(nmse, joint_mse, 0, 0, fit.seconds)


@in_float64
def kernel(arm: Arm, *, friction: bool, every: int = 10, serial: bool = True, tests: Sequence[int] = TESTS) -> Outcome:
    """Trigonometric energies in kernel form, which know no kinematics; other arguments as for `learned`.

    Args:
        serial: whether they know that each body carries the next.
    """
    train = lip_trajectories(arm, friction=friction, every=every)
    laws = FRICTION if friction else ()
    needs = arm.tree.needs._replace(joint_friction=laws, velocity_scale=VELOCITY_SCALE)
    fit = fit_kernel(needs, train, serial=serial)
    model = CATALOGUE["trigonometric-kernel"].factory(needs, samples=fit.samples, serial=serial)
    system = model.energies(fit.parameters)
    joint_mse = np.mean((torques_of(system, train) - train.tau) ** 2, axis=0)
    nmse = unseen_errors(arm, system, friction=friction, tests=tests, every=TEST_EVERY)
    return Outcome(nmse, joint_mse, 0, 0, fit.seconds)


def unseen_errors(
    arm: Arm, system: RecursiveSystem, *, friction: bool, tests: Sequence[int], every: int = 1
) -> Float[np.ndarray, "T d"]:
    """nMSE by test motion and joint, against torques without noise; of the motions' samples `every` so many."""
    test = lip_trajectories(arm, tests, friction=friction, noise=0.0, every=every)
    errors = (torques_of(system, test) - test.tau) ** 2
    motions = [test.trajectory == index for index in range(len(tests))]
    return np.array([errors[motion].mean(axis=0) / test.tau[motion].var(axis=0) for motion in motions])


def torques_of(system: Any, data: Trajectories) -> Float[np.ndarray, "N d"]:
    """Torques of a system's inverse dynamics along the samples of the data."""
    inverse = jax.jit(jax.vmap(dynamics(system).inverse_dynamics), compiler_options=quick_compilation())
    states = (data.q, data.qd, data.qdd)
    # The memory of a kernel grows with the number of states.
    pieces = [slice(first, first + STATES) for first in range(0, len(data.q), STATES)]
    return np.concatenate([inverse(*(each[piece] for each in states)) for piece in pieces])


def kernel_rows(
    name: str, *, friction: bool, every: int = 10, serial: bool = True, tests: Sequence[int] = TESTS
) -> list[Row]:
    """Numbers of one arm, by name; the published errors of the paper's kernel are the bounds."""
    found = kernel(ARMS[name](), friction=friction, every=every, serial=serial, tests=tests)
    means = found.nmse.mean(axis=1)
    compared = serial and every == 10 and not friction
    reference = PUBLISHED.get(name) if compared else None
    case = f"lip/{name}/{'friction' if friction else 'frictionless'}/{5000 // every}/kernel"
    case = case if serial else f"{case}-any-order"
    return [
        Row(case, "nmse_mean_median", float(np.median(means)), reference=reference, bound=reference),
        Row(case, "nmse_mean_worst", float(means.max())),
        *(
            Row(case, f"nmse_joint_{joint + 1}", float(value))
            for joint, value in enumerate(np.median(found.nmse, axis=0))
        ),
        Row(case, "fit_seconds", found.seconds, "s"),
    ]


def rows(
    name: str, *, friction: bool, every: int = 10, seeds: Sequence[int] = (0,), tests: Sequence[int] = TESTS
) -> list[Row]:
    """Numbers of one arm, by name, over seeds of the starts, and of the fit with known kinematics."""
    arm = ARMS[name]()
    reference = known(arm, friction=friction, every=every, tests=tests)
    fits = [learned(arm, friction=friction, every=every, seed=seed, tests=tests) for seed in seeds]
    means = np.array([np.median(fit.nmse.mean(axis=1)) for fit in fits])
    floors = np.array([np.mean(fit.joint_mse / reference.joint_mse) for fit in fits])
    reached = np.mean(floors < 1.1)
    exact = float(np.median(reference.nmse.mean(axis=1)))
    bound = TARGET if len(arm.limits) >= 6 and every <= 10 else None
    case = f"lip/{name}/{'friction' if friction else 'frictionless'}/{5000 // every}"
    return [
        Row(f"{case}/learned-tree", "nmse_mean_median", float(np.median(means)), reference=exact, bound=bound),
        Row(f"{case}/learned-tree", "nmse_mean_worst", float(means.max()), reference=exact),
        *(
            Row(f"{case}/learned-tree", f"nmse_joint_{joint + 1}", float(value))
            for joint, value in enumerate(np.median([np.median(fit.nmse, axis=0) for fit in fits], axis=0))
        ),
        Row(f"{case}/learned-tree", "training_error_over_floor", float(np.median(floors)), bound=1.1),
        Row(f"{case}/learned-tree", "share_of_seeds_at_floor", float(reached), bound=0.9, at_least=True),
        Row(f"{case}/learned-tree", "descents", float(np.median([fit.descents for fit in fits]))),
        Row(f"{case}/learned-tree", "fit_seconds", float(max(fit.seconds for fit in fits)), "s", bound=180.0),
        Row(f"{case}/known-kinematics", "nmse_mean_median", exact),
        Row(f"{case}/known-kinematics", "fit_seconds", reference.seconds, "s"),
    ]
