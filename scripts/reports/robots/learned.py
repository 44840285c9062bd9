"""Models that do not know the kinematics: torques on unseen motions by learned trees, kernels and networks.

Most arms follow the LIP protocol (`simulated_arms`): one motion of 50 s trains, motions of other seeds test. Torques of
the tests are exact, so that errors may fall below the noise of the training torques.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from dln_jax import Adam, GaussNewton, fit, make_delan
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import Split
from dln_jax.learning import dynamics, objectives
from dln_jax.learning.kernel import fit_kernel
from dln_jax.learning.kinematics.fit import fit_tree
from dln_jax.learning.kinematics.search import Search
from dln_jax.learning.linear import fit_linear
from dln_jax.mechanics import equations
from dln_jax.mechanics.trees.description import Tree, make_tree
from dln_jax.mechanics.trees.inertia import inertial_parameters
from dln_jax.mechanics.trees.recursions import newton_euler
from dln_jax.models.kernel import make_trigonometric_kernel
from dln_jax.models.trees import make_rigid_tree, make_serial_tree
from dln_jax.precision import quick_compilation
from dln_jax.types import FrictionLaw, Needs
from scripts.reports.robots.simulated_arms import Arm, lip_trajectories, panda, skew_arm, sliding_arm, waves
from scripts.reports.run import Numbers

ARMS: dict[str, Callable[[], Arm]] = {
    **{f"panda-{d}": (lambda d=d: panda(d)) for d in range(3, 8)},
    "skew-arm": skew_arm,
    "sliding-arm": sliding_arm,
}
STRIDES = {500: 10, 150: 33, 50: 100}
"""Strides of the training samples, which are 10 ms apart, by their number."""
VELOCITY_SCALE = 1e-3
"""Velocity scale of the models' dry friction, rad/s or m/s; the arms' own dry friction is discontinuous."""
FRICTION: tuple[FrictionLaw, ...] = ("viscous", "coulomb", "offset")
STATES = 5_001
"""Number of states that the inverse dynamics takes at once: the memory of a kernel grows with it."""
KERNELS = (
    *itertools.product([f"panda-{d}" for d in range(3, 8)], (500,), (False, True), (True,)),
    *itertools.product(("panda-7",), (150, 50), (False, True), (True,)),
    *itertools.product(("panda-7",), (500,), (False, True), (False,)),
)
"""Arm, number of samples, friction, and whether a kernel knows that each body carries the next."""
CHAIN, D = (-1, 0, 1, 2, 3), 5
PLANTS = {  # parents, order of the coordinates, springs in N m/rad, amplitudes in rad
    "branched": ((-1, 0, 1, 0, 3), [0, 1, 2, 3, 4], [0, 0, 0, 0, 0], [2, 2, 2, 2, 2]),
    "wrong-order": (CHAIN, [3, 0, 4, 2, 1], [0, 0, 0, 0, 0], [2, 2, 2, 2, 2]),
    "flexible": (CHAIN, [0, 1, 2, 3, 4], [0, 0, 300, 0, 80], [2, 2, 0.1, 2, 0.1]),
}


def learned_trees(
    *, arms: tuple[str, ...], samples: tuple[int, ...] = (500,), frictions: Sequence[bool] = (False, True),
    seeds: int = 3, tests: int = 20,
) -> Numbers:  # fmt: skip
    """Trees learned without their kinematics, over seeds of the starts, and a linear fit with known frames."""
    numbers = {}
    for name, count, friction in itertools.product(arms, samples, frictions):
        arm, case = ARMS[name](), case_name(name, count, friction)
        train = lip_trajectories(arm, friction=friction, every=STRIDES[count])
        model = make_rigid_tree(arm.tree, friction=friction, velocity_scale=VELOCITY_SCALE)
        known = fit_linear(model, train, negligible=1e-12)
        system = model.energies(known.parameters)
        floor = np.mean((torques_of(system, train) - train.tau) ** 2, axis=0)
        exact = unseen_errors(arm, system, friction, tests).mean(axis=1)
        needs = arm.tree.needs._replace(friction=friction)
        fits = [fit_tree(needs, train, velocity_scale=VELOCITY_SCALE, settings=Search(seed=s)) for s in range(seeds)]
        learned = make_serial_tree(needs, velocity_scale=VELOCITY_SCALE)
        errors = [unseen_errors(arm, learned.energies(fit.parameters), friction, tests).mean(axis=1) for fit in fits]
        medians = np.median(errors, axis=1)
        floors = np.array([np.mean(fit.joint_mse / floor) for fit in fits])
        numbers[f"{case}/learned-tree"] = {
            "nmse_mean_median": np.median(medians),
            "nmse_mean_worst": np.max(medians),
            "nmse_worst_test": np.max(errors),
            "training_error_over_floor": np.median(floors),
            "share_of_seeds_at_floor": np.mean(floors < 1.1),
            "descents": np.median([len(fit.losses) for fit in fits]),
            "fit_seconds": max(fit.seconds for fit in fits),
        }
        numbers[f"{case}/known-kinematics"] = {"nmse_mean_median": np.median(exact), "fit_seconds": known.seconds}
    return numbers


def kernels(*, fits: Sequence[tuple[str, int, bool, bool]] = KERNELS, tests: int = 20) -> Numbers:
    """Trigonometric energies in kernel form, which know no kinematics, on two samples per second of the tests."""
    numbers = {}
    for name, count, friction, serial in fits:
        arm = ARMS[name]()
        train = lip_trajectories(arm, friction=friction, every=STRIDES[count])
        needs = arm.tree.needs._replace(joint_friction=FRICTION if friction else (), velocity_scale=VELOCITY_SCALE)
        measured = fit_kernel(needs, train, serial=serial)
        model = make_trigonometric_kernel(needs, samples=measured.samples, serial=serial)
        errors = unseen_errors(arm, model.energies(measured.parameters), friction, tests, every=50)
        numbers[f"{case_name(name, count, friction)}/kernel{'' if serial else '-any-order'}"] = {
            "nmse_mean_median": np.median(errors.mean(axis=1)),
            "nmse_mean_worst": np.max(errors.mean(axis=1)),
            **{f"nmse_joint_{joint + 1}": error for joint, error in enumerate(np.median(errors, axis=0))},
            "fit_seconds": measured.seconds,
        }
    return numbers


def case_name(name: str, samples: int, friction: bool) -> str:
    """Stable name of an arm's rows."""
    return f"lip/{name}/{'friction' if friction else 'frictionless'}/{5000 // STRIDES[samples]}"


def unseen_errors(arm: Arm, system, friction: bool, tests: int, every: int = 1) -> Float[np.ndarray, "T d"]:
    """Mean square error over variance by test motion and joint; `every` is the stride of the test samples."""
    test = lip_trajectories(arm, range(101, 101 + tests), friction=friction, noise=0.0, every=every)
    errors = (torques_of(system, test) - test.tau) ** 2
    motions = [test.trajectory == index for index in range(tests)]
    return np.array([errors[motion].mean(axis=0) / test.tau[motion].var(axis=0) for motion in motions])


def torques_of(system, data: Trajectories) -> Float[np.ndarray, "N d"]:
    """Torques of a system's inverse dynamics along the samples of the data."""
    inverse = equations.dynamics(system).inverse_dynamics
    program = jax.jit(
        lambda states: jax.lax.map(lambda state: inverse(*state), states, batch_size=STATES),
        compiler_options=quick_compilation(),
    )
    return np.asarray(program((data.q, data.qd, data.qdd)))


def unknown_trees(
    *, plants: tuple[str, ...] = tuple(PLANTS), arms_of_each: int = 1, fit_seconds: float = 60.0
) -> Numbers:
    """Five revolute joints that are not a rigid chain in the order of their coordinates.

    Errors on five unseen motions without noise, from 500 noisy samples of five others; one more selects parameters.
    """
    needs, means = Needs(joints=("revolute",) * D), {}
    for plant, seed in itertools.product(plants, range(arms_of_each)):
        train, validation = recorded(plant, seed, 0, 5), recorded(plant, seed, 500, 1)
        suited = dynamics.suited_network(needs, train)
        keywords: dict[str, Any] = suited.keywords
        network = make_delan(needs, **keywords, dtype=float)
        optimiser = GaussNewton(steps=200) if suited.optimizer == "gauss-newton" else Adam(steps=suited.steps)
        task = dynamics.problem(network, Split(train, validation, validation), objectives.SCALED_TORQUE, seeds=seed)
        tree = fit_tree(needs, train, validation, settings=Search(seconds=fit_seconds, seed=seed))
        systems = {
            "learned-tree": make_serial_tree(needs).energies(tree.parameters),
            "structured-delan": network.energies(fit(task, optimiser, seconds=fit_seconds).parameters),
        }
        for name, serial in {"kernel": True, "kernel-any-order": False}.items():
            kernel = fit_kernel(needs, train, samples=500, serial=serial)
            systems[name] = make_trigonometric_kernel(needs, samples=500, serial=serial).energies(kernel.parameters)
        test = recorded(plant, seed, 900, 5, every=50, noise=0.0)
        for name, system in systems.items():
            squares = np.mean((torques_of(system, test) - test.tau) ** 2, axis=0)
            error = float(np.mean(squares / test.tau.var(axis=0)))
            means.setdefault(f"lip/{plant}/frictionless/500/{name}", []).append(error)
    return {
        case: {"nmse_mean_median": np.median(values), "nmse_mean_worst": np.max(values)}
        for case, values in means.items()
    }


def recorded(plant: str, seed: int, first: int, count: int, *, every: int = 25, noise: float = 0.01) -> Trajectories:
    """Motions of 25 s, sums of eight sines up to 0.64 Hz; torque noise relative to the torques' deviations."""
    parents, order, springs, amplitudes = PLANTS[plant]
    t, w = np.arange(0, 25, 0.01)[::every], 2 * np.pi * 0.08 * np.arange(1, 9)[:, None, None]
    motions = []
    for index in range(count):
        random = np.random.default_rng([11, 1000 * seed + first, index])
        a = random.uniform(-1, 1, size=(8, 1, D)) / np.sqrt(np.arange(1, 9))[:, None, None]
        phase = w * t[:, None] + random.uniform(0, 2 * np.pi, size=(8, D))[:, None]
        a = a * 1.4 * np.array(amplitudes) / np.abs(a).sum(axis=0)
        motions.append(waves(a, w, phase, axis=0))
    q, qd, qdd = (np.concatenate(parts) for parts in zip(*motions, strict=True))
    tree = random_tree(parents, seed)
    tau = np.asarray(jax.jit(jax.vmap(lambda *state: newton_euler(tree, *state)))(q, qd, qdd))
    tau = tau + np.array(springs) * q
    tau = tau + noise * tau.std(axis=0) * np.random.default_rng([13, seed, first]).normal(size=tau.shape)
    q, qd, qdd, tau = (array[:, order] for array in (q, qd, qdd, tau))
    index, label = np.repeat(np.arange(count), len(t)), np.array([str(number) for number in range(count)])
    return Trajectories(np.tile(t, count), q, qd, qdd, tau, index, label, needs=Needs(joints=("revolute",) * D))


def random_tree(parents: tuple[int, ...], seed: int) -> Tree:
    """Random frames with links of 0.3 m, and bodies from 3 kg at the base to 1.2 kg."""
    random = np.random.default_rng([7, seed])
    rotations, _ = np.linalg.qr(random.normal(size=(D, 3, 3)))
    rotations = rotations * np.sign(np.linalg.det(rotations))[:, None, None]
    places = random.normal(size=(D, 3))
    places = 0.3 * places / np.linalg.norm(places, axis=1, keepdims=True)
    bodies = []
    for mass in 3.0 * 0.8 ** np.arange(D):
        A, centre = random.normal(size=(3, 3)), 0.12 * random.normal(size=3)
        bodies.append(inertial_parameters(mass, centre, mass * (0.004 * np.eye(3) + 0.002 * A @ A.T)))
    axes = np.tile([0.0, 0.0, 1.0], (D, 1))
    return make_tree(parents, ("revolute",) * D, rotations, places, axes, bodies, armature=np.full(D, 0.02))
