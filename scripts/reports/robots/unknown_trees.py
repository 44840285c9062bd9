"""Five revolute joints that are not a rigid chain in the order of their coordinates: torques of unseen motions."""

from typing import Any

import jax
import numpy as np

from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import Split
from dln_jax.learning import Adam, GaussNewton, dynamics, fit, fit_kernel, objectives
from dln_jax.learning.kinematics import Search, fit_tree
from dln_jax.mechanics import trees
from dln_jax.metrics.report import Row
from dln_jax.models import make_delan, make_serial_tree, make_trigonometric_kernel
from dln_jax.types import Needs
from scripts.reports.robots.lip import torques_of

D = 5
NEEDS = Needs(joints=("revolute",) * D)
CHAIN, BRANCHED = (-1, 0, 1, 2, 3), (-1, 0, 1, 0, 3)
PLANTS = {  # parents, order of the coordinates, springs in N m/rad, amplitudes in rad
    "branched": (BRANCHED, [0, 1, 2, 3, 4], [0, 0, 0, 0, 0], [2, 2, 2, 2, 2]),
    "wrong-order": (CHAIN, [3, 0, 4, 2, 1], [0, 0, 0, 0, 0], [2, 2, 2, 2, 2]),
    "flexible": (CHAIN, [0, 1, 2, 3, 4], [0, 0, 300, 0, 80], [2, 2, 0.1, 2, 0.1]),
}
SECONDS = 60.0
"""Time limit of the search for a tree, and of the training of a network."""


def random_tree(parents: tuple[int, ...], seed: int) -> trees.Tree:
    """Random frames with links of 0.3 m, and bodies from 3 kg at the base to 1.2 kg."""
    random = np.random.default_rng([7, seed])
    rotations, _ = np.linalg.qr(random.normal(size=(D, 3, 3)))
    rotations = rotations * np.sign(np.linalg.det(rotations))[:, None, None]
    places = random.normal(size=(D, 3))
    places = 0.3 * places / np.linalg.norm(places, axis=1, keepdims=True)
    bodies = []
    for mass in 3.0 * 0.8 ** np.arange(D):
        A, centre = random.normal(size=(3, 3)), 0.12 * random.normal(size=3)
        bodies.append(trees.inertial_parameters(mass, centre, mass * (0.004 * np.eye(3) + 0.002 * A @ A.T)))
    axes = np.tile([0.0, 0.0, 1.0], (D, 1))
    return trees.make_tree(parents, NEEDS.joints, rotations, places, axes, bodies, armature=np.full(D, 0.02))


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
        waves = a * np.sin(phase), a * w * np.cos(phase), -a * w**2 * np.sin(phase)
        motions.append([wave.sum(axis=0) for wave in waves])
    q, qd, qdd = (np.concatenate(parts) for parts in zip(*motions, strict=True))
    tree = random_tree(parents, seed)
    tau = np.asarray(jax.jit(jax.vmap(lambda *state: trees.newton_euler(tree, *state)))(q, qd, qdd))
    tau = tau + np.array(springs) * q
    tau = tau + noise * tau.std(axis=0) * np.random.default_rng([13, seed, first]).normal(size=tau.shape)
    q, qd, qdd, tau = (array[:, order] for array in (q, qd, qdd, tau))
    index, label = np.repeat(np.arange(count), len(t)), np.array([str(number) for number in range(count)])
    return Trajectories(np.tile(t, count), q, qd, qdd, tau, index, label, needs=NEEDS)


def rows(plant: str, seeds: range) -> list[Row]:
    """Errors of the models on five unseen motions without noise, from 500 noisy samples of five others."""
    means: dict[str, list[float]] = {}
    for seed in seeds:
        train, validation = recorded(plant, seed, 0, 5), recorded(plant, seed, 500, 1)
        suited = dynamics.suited_network(NEEDS, train)
        keywords: dict[str, Any] = suited.keywords
        network = make_delan(NEEDS, **keywords, dtype=float)
        optimiser = GaussNewton(steps=200) if suited.optimizer == "gauss-newton" else Adam(steps=suited.steps)
        sets = Split(train, validation, validation)
        task = dynamics.problem(network, sets, objectives.SCALED_TORQUE, seeds=seed)
        tree = fit_tree(NEEDS, train, validation, settings=Search(seconds=SECONDS, seed=seed))
        systems = {
            "learned-tree": make_serial_tree(NEEDS).energies(tree.parameters),
            "structured-delan": network.energies(fit(task, optimiser, seconds=SECONDS).parameters),
        }
        for name, serial in {"kernel": True, "kernel-any-order": False}.items():
            kernel = fit_kernel(NEEDS, train, samples=500, serial=serial)
            systems[name] = make_trigonometric_kernel(NEEDS, samples=500, serial=serial).energies(kernel.parameters)
        test = recorded(plant, seed, 900, 5, every=50, noise=0.0)
        for name, system in systems.items():
            squares = np.mean((torques_of(system, test) - test.tau) ** 2, axis=0)
            means.setdefault(name, []).append(float(np.mean(squares / test.tau.var(axis=0))))
    cases = {f"lip/{plant}/frictionless/500/{name}": values for name, values in means.items()}
    summaries = {"nmse_mean_median": np.median, "nmse_mean_worst": np.max}
    return [Row(case, name, float(of(values))) for case, values in cases.items() for name, of in summaries.items()]
