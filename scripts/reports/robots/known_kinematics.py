"""Arms with known frames, identified from logs: torque errors on unseen motions, tracking at 1 kHz, and added terms.

The rival gets the same samples, filter and columns, and in a second run also our velocity scales. Errors are those on
noise-free unseen motions of the true arm.

Two ways to prepare data stand beside these. Filters derive the equations of a linear fit, of the same tree with
friction, from a noisy log. Designed motions have the same period, samples and noise as random ones.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax import joint_dissipation, tree_system
from dln_jax.data.encoders.smoothing import smooth
from dln_jax.data.schema import Trajectories, from_arrays
from dln_jax.data.splits import every, select
from dln_jax.identification.excitation.design import CRITERIA, Design, make_designer, random_designs
from dln_jax.identification.excitation.limits import MotionLimits
from dln_jax.identification.excitation.task import make_task
from dln_jax.identification.identify import identify
from dln_jax.identification.rigid_tree import choose_terms
from dln_jax.learning.friction import Terms, fit_friction
from dln_jax.learning.linear import fit_linear, parameters_of
from dln_jax.learning.momentum import fit_momentum
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees.description import Tree, dh_frames, serial
from dln_jax.mechanics.trees.inertia import inertial_parameters
from dln_jax.models.trees import make_rigid_tree
from dln_jax.types import FrictionLaw
from scripts.reports.robots.arm import (
    D,
    arm,
    error_of,
    exact_torque,
    follow,
    logs,
    measured,
    motion,
    regression,
    torque_of,
)
from scripts.reports.robots.simulated_arms import panda, waves
from scripts.reports.run import Numbers

LAWS = ("viscous", "coulomb", "offset")
USUAL_SCALE = 0.01
"""Velocity scale of dry friction, rad/s, where it is not fitted: for the rival and our robust fit."""
DECIMATE = 3
"""Stride of the fitted samples; torques are not filtered, which would smear dry friction."""


def rough(tree: Tree) -> Tree:
    """The tree with inertias that an engineer would guess: balls of 2 kg at the joints, and no armature."""
    ball = np.array([2.0, 0, 0, 0, 0.02, 0, 0, 0.02, 0, 0.02])
    return tree._replace(inertias=np.tile(ball, (tree.degrees_of_freedom, 1)), armature=np.full(D, 0.05))


def identified(tree: Tree, data: Trajectories, scale, *, robust: bool = False):
    """Model and parameters of our identification: physically consistent, torques weighted by their noise.

    Args:
        tree: tree with known frames.
        data: data to fit.
        scale: velocity scale of dry friction, rad/s, by joint or one for all.
        robust: use Huber's loss, which is linear in errors beyond the noise, such as at reversals of friction.
    """
    shape = tuple(np.broadcast_to(scale, D).tolist())
    model = make_rigid_tree(rough(tree), friction=LAWS, velocity_scale=shape)
    start = model.init(jax.random.key(0))._replace(viscous=jnp.full(D, 0.5), coulomb=jnp.full(D, 0.5))
    solution = identify(model, start, data, joints=tree.joints, robust=robust)
    return model, parameters_of(solution.theta, start)


def noisy(*, seeds: int = 5, motions: int = 15, unseen: int = 6) -> Numbers:
    """Noisy encoders and torques, dry friction: our fit (fitted scales, or robust), and Pinocchio's regressor.

    Errors are means over joints. Each method is also the feed-forward of PD control along the unseen motions.
    """
    robot = arm(coulomb=True)
    true = tree_system(robot.tree, joint_dissipation(robot.damping, robot.coulomb, velocity_scale=USUAL_SCALE))
    exact = jax.jit(jax.vmap(dynamics(true).inverse_dynamics))
    errors: dict[str, list[float]] = {}
    tracked: dict[str, list[float]] = {}
    for seed in range(seeds):
        random = np.random.default_rng(seed)
        train, test = (logs(robot, random, count) for count in (motions, unseen))
        data = every(smooth(from_arrays(measured(train, random))).data, DECIMATE)
        scales = fit_friction(rough(robot.tree), data, LAWS).shape["velocity_scale"]
        methods = {
            "ours": torque_of(*identified(robot.tree, data, scales)),
            "ours-robust": torque_of(*identified(robot.tree, data, USUAL_SCALE, robust=True)),
            "pinocchio": regression(robot.tree, data, USUAL_SCALE),
            "pinocchio-with-our-scales": regression(robot.tree, data, scales),
        }
        methods = {name: torque for name, torque in methods.items() if torque}
        for name, torque in methods.items():
            errors.setdefault(name, []).append(float(error_of(torque, test).mean()))
        for _ in range(unseen):
            wanted = motion(random)
            feeds = {"without": None, "simulator": exact_torque(robot, wanted)}
            feeds["true-parameters"] = np.asarray(exact(*wanted))
            for name, feed in (feeds | {name: torque(*wanted) for name, torque in methods.items()}).items():
                q, _, _, _, reference = follow(robot, wanted, feed)
                tracked.setdefault(name, []).append(1e3 * float(np.sqrt(np.mean((q - reference) ** 2))))
    return summary(errors, tracked)


def summary(errors: dict[str, list[float]], tracked: dict[str, list[float]]) -> Numbers:
    """Medians and worst over seeds, and medians of our errors relative to the rival's and to true parameters."""
    numbers = {}
    for name, values in errors.items():
        numbers[f"arm/noisy-coulomb/{name}"] = {"nmse": np.median(values), "nmse_worst": np.max(values)}
        if name.startswith("pinocchio"):
            numbers["arm/noisy-coulomb/ours"][f"over_{name}"] = np.median(np.divide(errors["ours"], values))
    for name, values in tracked.items():
        numbers[f"arm/tracking/{name}"] = {"rms_mrad": np.median(values)}
        if name.startswith("ours"):
            ratio = np.median(np.divide(values, tracked["true-parameters"]))
            numbers[f"arm/tracking/{name}"]["over_true_parameters"] = ratio
    return numbers


# An arm of two joints moves for 20 s while its gears warm up from 20 to 45 °C.
NOISE, SAMPLES, STEP = 0.02, 800, 0.025
PLANT_LAWS: tuple[FrictionLaw, ...] = ("viscous", "coulomb")
LINK = inertial_parameters(2.0, [0.05, 0.02, 0.1], np.diag([0.02, 0.03, 0.01]))
ARM = serial(*dh_frames([[0, 0, 0.3, 0], [-np.pi / 2, 0.1, 0, 0]]), [LINK] * 2, armature=[0.1, 0.05])
PLANTS: dict[str, dict[str, Any]] = {
    "none": {},
    "coupled": {"coupled": ((0, 1),)},
    "load": {"friction": (*PLANT_LAWS, "load"), "load": (0.2, 0.1)},
    "temperature": {"cooling": (0.02, 0.01), "reference_temperature": 25.0},
}


def added_terms(*, logs_without: int = 20, logs_with: int = 5) -> Numbers:
    """How often cross-validation keeps terms that a plant has, or not: shares of its logs, by plant and term.

    An arm of two joints moves for 20 s while its gears warm up; torques have noise of about 1 % of their size.
    """
    additions = {"coupled": {"coupled": ((0, 1),)}, "load": {"laws": ("load",)}, "temperature": {"cooling": True}}
    numbers = {}
    for plant, keywords in PLANTS.items():
        count = logs_without if plant == "none" else logs_with
        model = make_rigid_tree(ARM, velocity_scale=0.02, **{"friction": PLANT_LAWS, **keywords})
        energies: Any = model.energies  # of a rigid tree, which takes a temperature too
        parameters = model.init(jax.random.key(0))._replace(viscous=np.array([0.4, 0.3]), coulomb=np.array([0.5, 0.3]))
        if plant == "coupled":
            parameters = parameters._replace(coupling={"1_2": np.array(0.03)})

        def torque(q, qd, qdd, temperature, energies=energies, parameters=parameters):
            return dynamics(energies(parameters, temperature)).inverse_dynamics(q, qd, qdd)

        program = jax.jit(jax.vmap(torque))
        kept = {f"share_keeping_{name}": 0.0 for name in additions}
        for seed in range(count):
            random, w = np.random.default_rng(seed), np.arange(1.0, 6.0)[:, None]
            t = STEP * np.arange(SAMPLES)
            sizes, phases = 0.7 * random.normal(size=(2, 5, 1)), random.uniform(0, 2 * np.pi, (2, 5, 1))
            q, qd, qdd = (wave.T for wave in waves(sizes / w, w, w * t + phases, axis=1))
            state = {"q": q, "qd": qd, "qdd": qdd}
            state["temperature"] = np.stack([20 + 25 * (1 - np.exp(-t / 8))] * 2, axis=1)
            tau = np.asarray(program(**state)) + NOISE * random.normal(size=(SAMPLES, 2))
            log = from_arrays({"t": t, "trajectory": np.zeros(SAMPLES, int), "tau": tau, **state})
            for name in choose_terms(ARM, log, Terms(PLANT_LAWS), additions)[1]:
                kept[f"share_keeping_{name}"] += 1 / count
        numbers[f"added-terms/{plant}"] = kept
    return numbers


TOLERANCES: dict[str, Any] = {"negligible": 1e-9, "rank_tolerance": 1e-8}


def encoders(*, motions: int = 15, unseen: int = 6, parts: int = 3) -> Numbers:
    """Median and worst nMSE over disjoint parts of the motions, with viscous friction and with MuJoCo's dry friction.

    Ways: exact rates; rates by differences; q filtered at the cut-off chosen from its spectra, with raw tau; tau
    filtered like q; and momenta of windows, which need no accelerations.
    """
    numbers = {}
    for name, robot in (("viscous", arm(coulomb=False)), ("coulomb", arm(coulomb=True))):
        random = np.random.default_rng(0)
        exact, test = (logs(robot, random, count) for count in (motions, unseen))
        model = make_rigid_tree(robot.tree, friction=True, velocity_scale=0.01)
        errors: dict[str, list[float]] = {}
        for seed, part in enumerate(np.array_split(np.arange(motions), parts)):
            clean = select(exact, part)
            log = from_arrays(measured(clean, np.random.default_rng(seed)))
            filtered = smooth(log)
            twice = smooth(log, 2 * filtered.cutoff)
            fits = {
                "exact-rates": (fit_linear, clean._replace(tau=log.tau)),
                "raw-differences": (fit_linear, log),
                "acceleration": (fit_linear, filtered.data),
                "acceleration-torque-filtered": (fit_linear, smooth(log, filter_torque=True).data),
                "acceleration-twice-the-cutoff": (fit_linear, twice.data),
                "momentum": (fit_momentum, filtered.data),
                "momentum-twice-the-cutoff": (fit_momentum, twice.data),
            }
            for way, (fit, data) in fits.items():
                torque = torque_of(model, fit(model, data, **TOLERANCES)[0])
                errors.setdefault(way, []).append(float(error_of(torque, test).mean()))
        for way, values in errors.items():
            numbers[f"encoders/{name}/{way}"] = {"nmse_median": np.median(values), "nmse_worst": np.max(values)}
    return numbers


def excitation(*, joints: int = 7, designs: int = 6, draws: int = 60) -> Numbers:
    """Ratios of parameter errors after designed and random motions of the same series of a Panda, by criterion."""
    robot = panda(joints)
    model = make_rigid_tree(robot.tree, friction=True, velocity_scale=0.05)
    free = np.tile([-np.inf, np.inf], (joints, 1))
    limits = MotionLimits(robot.limits, robot.rates, robot.accelerations, free)
    task = make_task(model, model.init(jax.random.key(0)), limits, period=20.0, harmonics=5)
    drawn, starts = random_designs(task, designs), random_designs(task, designs, seed=1)
    numbers = {"excitation/random": {"condition_median": np.median([design.condition for design in drawn])}}
    for name, criterion in CRITERIA.items():
        best = make_designer(task, criterion)
        designed = [best([start]) for start in starts]
        ratios = error_ratios(designed, drawn, seeds=draws)
        numbers[f"excitation/{name}"] = {
            "condition_median": np.median([design.condition for design in designed]),
            "error_worst": np.max(ratios),
            "error_median": np.median(ratios),
        }
    return numbers


def error_ratios(
    designed: Sequence[Design], drawn: Sequence[Design], *, seeds: int = 50
) -> Float[np.ndarray, " seeds"]:
    """Errors of least squares after designed motions over those after random ones by seed.

    They are root mean squares over parameters, in units of each parameter's standard deviation after random motions.
    The motions are compared pair by pair, with new noise for every seed. Values below one favour designed motions.
    """
    scale = np.sqrt(np.mean([np.diag(np.linalg.inv(design.information)) for design in drawn], axis=0))
    ratios = []
    for seed in range(seeds):
        noise = np.random.default_rng(seed).normal(size=len(scale))
        sizes = []
        for designs in (designed, drawn):
            factor = np.linalg.cholesky(designs[seed % len(designs)].information)
            sizes.append(np.sqrt(np.mean((np.linalg.solve(factor.T, noise) / scale) ** 2)))
        ratios.append(sizes[0] / sizes[1])
    return np.array(ratios)
