"""Coupled motors, friction by load and by temperature: found where they are, and left out where they are not."""

import functools

import jax
import numpy as np
import pytest

from dln_jax.data.schema import from_arrays
from dln_jax.learning.friction import fit_friction
from dln_jax.learning.friction_selection import choose_terms
from dln_jax.learning.friction_terms import terms_of
from dln_jax.mechanics import trees
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.rigid_tree import make_rigid_tree

LINK = trees.inertial_parameters(2.0, [0.05, 0.02, 0.1], np.diag([0.02, 0.03, 0.01]))
ARM = trees.serial(*trees.dh_frames([[0, 0, 0.3, 0], [-np.pi / 2, 0.1, 0, 0]]), [LINK] * 2, armature=[0.1, 0.05])
NOISE, SAMPLES, LAWS = 0.02, 800, ("viscous", "coulomb")
PLANT = {"friction": LAWS, "velocity_scale": 0.02}
EXTRA = {
    "nothing": {},
    "coupled": {"coupled": ((0, 1),)},
    "load": {"load": (0.2, 0.1), "friction": (*LAWS, "load")},
    "cooling": {"cooling": (0.02, 0.01), "reference_temperature": 25.0},
}
OPTIONS = {"cooling": False, "motors": None, "coupled": ()}
TERMS = terms_of(LAWS, None, (), **OPTIONS)
CANDIDATES = {
    "coupled": TERMS._replace(coupled=((0, 1),)),
    "load": terms_of(("load",), None, (), **OPTIONS),
    "cooling": TERMS._replace(learned=("cooling",)),
}


@functools.cache
def plant(extra):
    model = make_rigid_tree(ARM, **{**PLANT, **EXTRA[extra]})
    parameters = model.init(jax.random.key(0))._replace(viscous=np.array([0.4, 0.3]), coulomb=np.array([0.5, 0.3]))
    if extra == "coupled":
        parameters = parameters._replace(coupling={"1_2": np.array(0.03)})

    def torque(q, qd, qdd, temperature):
        return dynamics(model.energies(parameters, temperature)).inverse_dynamics(q, qd, qdd)

    return jax.jit(jax.vmap(torque))


def log_of(extra, seed):
    """A motion of five sines per joint while the gears warm up from 20 to 45 °C."""
    random, w = np.random.default_rng(seed), np.arange(1.0, 6.0)[:, None]
    t = 0.025 * np.arange(SAMPLES)
    sizes, phases = 0.7 * random.normal(size=(2, 5, 1)), random.uniform(0, 2 * np.pi, (2, 5, 1))
    q, qd, qdd = (
        np.sum(sizes * wave, axis=1).T
        for wave in (np.sin(w * t + phases) / w, np.cos(w * t + phases), -w * np.sin(w * t + phases))
    )
    temperature = np.stack([20 + 25 * (1 - np.exp(-t / 8))] * 2, axis=1)
    tau = np.asarray(plant(extra)(q, qd, qdd, temperature)) + NOISE * random.normal(size=q.shape)
    state = {"q": q, "qd": qd, "qdd": qdd, "tau": tau, "temperature": temperature}
    return from_arrays({"t": t, "trajectory": np.zeros(SAMPLES, int), **state})


def test_cooling_and_coupling_are_found_within_their_errors():
    fit = fit_friction(ARM, log_of("cooling", 0), LAWS, cooling=True, noise=NOISE)
    off = (fit.shape["cooling"] - EXTRA["cooling"]["cooling"]) / fit.shape_errors["cooling"]
    assert np.abs(off).max() < 3.5 and (fit.shape_errors["cooling"] < 2e-3).all()
    # The viscous coefficients are those at the reference, the log's mean temperature.
    factor = np.exp(-np.array([0.02, 0.01]) * (fit.reference_temperature - 25))
    off = (np.asarray(fit.parameters.viscous) - factor * [0.4, 0.3]) / np.asarray(fit.standard_errors.viscous)
    assert np.abs(off).max() < 3.5
    fit = fit_friction(ARM, log_of("coupled", 0), LAWS, coupled=((0, 1),), noise=NOISE)
    found, error = (float(part.coupling["1_2"]) for part in (fit.parameters, fit.standard_errors))
    assert abs(found - 0.03) < 3.5 * error < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("extra", EXTRA)
def test_cross_validation_keeps_the_terms_of_the_plant_and_no_other(extra):
    _, tried = choose_terms(ARM, log_of(extra, 1), TERMS, list(CANDIDATES.items()))
    assert [term.name for term in tried if term.kept] == [name for name in CANDIDATES if name == extra]
