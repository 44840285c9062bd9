"""Coupled motors, friction by load and by temperature: how often cross-validation keeps terms that a plant has, or not.

An arm of two joints moves for 20 s while its gears warm up from 20 to 45 °C; torques have noise of 0.02 N m, about 1 %
of their size. One plant has none of the terms, the others one each.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from dln_jax.data.schema import Trajectories, from_arrays
from dln_jax.learning.friction_selection import choose_terms
from dln_jax.learning.friction_terms import terms_of
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees import dh_frames, inertial_parameters, serial
from dln_jax.models.rigid_tree import make_rigid_tree
from dln_jax.types import FrictionLaw
from scripts.reports.case import Findings
from scripts.reports.rows import Row

NOISE, SAMPLES, STEP = 0.02, 800, 0.025
LAWS: tuple[FrictionLaw, ...] = ("viscous", "coulomb")
LINK = inertial_parameters(2.0, [0.05, 0.02, 0.1], np.diag([0.02, 0.03, 0.01]))
ARM = serial(*dh_frames([[0, 0, 0.3, 0], [-np.pi / 2, 0.1, 0, 0]]), [LINK] * 2, armature=[0.1, 0.05])
PLANTS: dict[str, dict[str, Any]] = {
    "none": {"friction": LAWS},
    "coupled": {"friction": LAWS, "coupled": ((0, 1),)},
    "load": {"friction": (*LAWS, "load"), "load": (0.2, 0.1)},
    "temperature": {"friction": LAWS, "cooling": (0.02, 0.01), "reference_temperature": 25.0},
}
LOGS, OF_PLANTS = 20, 5
"""Logs of the plant without terms, and of each other one."""


def added_terms(quick: bool) -> Findings:
    """Shares of logs that keep a term, by plant and term."""
    options: dict[str, Any] = {"cooling": False, "motors": None, "coupled": ()}
    terms = terms_of(LAWS, None, (), **options)
    candidates = {
        "coupled": terms._replace(coupled=((0, 1),)),
        "load": terms_of(("load",), None, (), **options),
        "temperature": terms._replace(learned=("cooling",)),
    }
    rows = []
    for plant in PLANTS:
        count = 2 if quick else LOGS if plant == "none" else OF_PLANTS
        kept = dict.fromkeys(candidates, 0)
        torque = torques_of(plant)
        for seed in range(count):
            for tried in choose_terms(ARM, log_of(torque, seed), terms, list(candidates.items()))[1]:
                kept[tried.name] += tried.kept
        for name, times in kept.items():
            words = f"of {count} logs; {'all' if name == plant else 'none'} should keep it"
            rows.append(Row(f"added-terms/{plant}", f"share_keeping_{name}", times / count, expected=words))
    return Findings(rows)


def torques_of(plant: str) -> Callable[..., Any]:
    """(q, qd, qdd, temperature) of N samples -> torques."""
    model = make_rigid_tree(ARM, velocity_scale=0.02, **PLANTS[plant])
    energies: Any = model.energies  # of a rigid tree, which takes a temperature too
    parameters = model.init(jax.random.key(0))._replace(viscous=np.array([0.4, 0.3]), coulomb=np.array([0.5, 0.3]))
    if plant == "coupled":
        parameters = parameters._replace(coupling={"1_2": np.array(0.03)})

    def torque(q, qd, qdd, temperature):
        return dynamics(energies(parameters, temperature)).inverse_dynamics(q, qd, qdd)

    return jax.jit(jax.vmap(torque))


def log_of(torque: Callable[..., Any], seed: int) -> Trajectories:
    """Five sines per joint, with noise on the torques."""
    random, w = np.random.default_rng(seed), np.arange(1.0, 6.0)[:, None]
    t = STEP * np.arange(SAMPLES)
    sizes, phases = 0.7 * random.normal(size=(2, 5, 1)), random.uniform(0, 2 * np.pi, (2, 5, 1))
    q, qd, qdd = (
        np.sum(sizes * wave, axis=1).T
        for wave in (np.sin(w * t + phases) / w, np.cos(w * t + phases), -w * np.sin(w * t + phases))
    )
    temperature = np.stack([20 + 25 * (1 - np.exp(-t / 8))] * 2, axis=1)
    tau = np.asarray(torque(q, qd, qdd, temperature)) + NOISE * random.normal(size=q.shape)
    state = {"q": q, "qd": qd, "qdd": qdd, "tau": tau, "temperature": temperature}
    return from_arrays({"t": t, "trajectory": np.zeros(SAMPLES, int), **state})
