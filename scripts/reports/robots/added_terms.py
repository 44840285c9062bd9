"""Coupled motors, friction by load and by temperature: how often cross-validation keeps terms that a plant has, or not.

An arm of two joints moves for 20 s while its gears warm up from 20 to 45 °C; torques have noise of 0.02 N m, about 1 %
of their size. One plant has none of the terms, the others one each.
"""

from typing import Any

import jax
import numpy as np

from dln_jax.data.schema import from_arrays
from dln_jax.learning.friction_selection import choose_terms
from dln_jax.learning.friction_terms import terms_of
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees import dh_frames, inertial_parameters, serial
from dln_jax.models.rigid_tree import make_rigid_tree
from dln_jax.types import FrictionLaw
from scripts.reports.run import Numbers

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


def added_terms(*, logs_without: int = 20, logs_with: int = 5) -> Numbers:
    """Shares of the logs of plants without or with a term that keep each term."""
    options: dict[str, Any] = {"cooling": False, "motors": None, "coupled": ()}
    terms = terms_of(LAWS, None, (), **options)
    candidates = {
        "coupled": terms._replace(coupled=((0, 1),)),
        "load": terms_of(("load",), None, (), **options),
        "temperature": terms._replace(learned=("cooling",)),
    }
    numbers = {}
    for plant, keywords in PLANTS.items():
        count = logs_without if plant == "none" else logs_with
        model = make_rigid_tree(ARM, velocity_scale=0.02, **keywords)
        energies: Any = model.energies  # of a rigid tree, which takes a temperature too
        parameters = model.init(jax.random.key(0))._replace(viscous=np.array([0.4, 0.3]), coulomb=np.array([0.5, 0.3]))
        if plant == "coupled":
            parameters = parameters._replace(coupling={"1_2": np.array(0.03)})

        def torque(q: Any, qd: Any, qdd: Any, temperature: Any, energies=energies, parameters=parameters) -> Any:
            return dynamics(energies(parameters, temperature)).inverse_dynamics(q, qd, qdd)

        program = jax.jit(jax.vmap(torque))
        kept = {f"share_keeping_{name}": 0.0 for name in candidates}
        for seed in range(count):
            random, w = np.random.default_rng(seed), np.arange(1.0, 6.0)[:, None]
            t = STEP * np.arange(SAMPLES)
            sizes, phases = 0.7 * random.normal(size=(2, 5, 1)), random.uniform(0, 2 * np.pi, (2, 5, 1))
            angles = w * t + phases
            waves = np.sin(angles) / w, np.cos(angles), -w * np.sin(angles)
            state = dict(zip(("q", "qd", "qdd"), (np.sum(sizes * wave, axis=1).T for wave in waves), strict=True))
            state["temperature"] = np.stack([20 + 25 * (1 - np.exp(-t / 8))] * 2, axis=1)
            tau = np.asarray(program(**state)) + NOISE * random.normal(size=(SAMPLES, 2))
            log = from_arrays({"t": t, "trajectory": np.zeros(SAMPLES, int), "tau": tau, **state})
            for tried in choose_terms(ARM, log, terms, list(candidates.items()))[1]:
                kept[f"share_keeping_{tried.name}"] += tried.kept / count
        numbers[f"added-terms/{plant}"] = kept
    return numbers
