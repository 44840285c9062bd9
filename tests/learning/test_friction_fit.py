"""Friction curves, by load, temperature and coupled motors: found with the inertias, within the stated errors."""

import functools

import jax
import numpy as np
import pytest
from calls import one_line
from motions import sums_of_sines
from planar_arm import ARM as PLANAR

from dln_jax.data.schema import from_arrays
from dln_jax.identification.rigid_tree import choose_terms
from dln_jax.learning.friction import Terms, fit_friction
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import FrictionShape
from dln_jax.models.trees import make_rigid_tree

# Axes at a right angle: in a plane the second link's inertia is a coupling.
ARM = PLANAR._replace(rotations=np.array([np.eye(3), [[1, 0, 0], [0, 0, 1], [0, -1, 0]]]))
NOISE, SAMPLES = 0.02, 800
LAWS = ("viscous", "coulomb")
COEFFICIENTS = {"viscous": (0.4, 0.3), "coulomb": (0.5, 0.3), "stribeck": (0.4, 0.3)}
SHAPES = {
    "nothing": {"friction": LAWS},
    "stribeck": {"friction": (*LAWS, "stribeck"), "stribeck_velocity": (0.2, 0.15)},
    "coupled": {"friction": LAWS, "coupled": ((0, 1),)},
    "load": {"friction": (*LAWS, "load"), "load": (0.2, 0.1)},
    "cooling": {"friction": LAWS, "cooling": (0.02, 0.01), "reference_temperature": 25.0},
}
"""Friction of the plants, by what they have beside viscous and dry friction."""
CANDIDATES = {"coupled": {"coupled": ((0, 1),)}, "load": {"laws": ("load",)}, "cooling": {"cooling": True}}


@functools.cache
def plant(extra):
    """Inverse dynamics of the arm, compiled once."""
    shape = SHAPES[extra]
    model = make_rigid_tree(ARM, velocity_scale=0.02, **shape)
    known = {name: np.array(COEFFICIENTS[name]) for name in shape["friction"] if name in COEFFICIENTS}
    if extra == "coupled":
        known["coupling"] = {"1_2": np.array(0.03)}
    parameters = model.init(jax.random.key(0))._replace(**known)

    def torque(q, qd, qdd, temperature):
        return dynamics(model.energies(parameters, temperature)).inverse_dynamics(q, qd, qdd)

    return jax.jit(jax.vmap(torque))


def log_of(extra, seed=0, noise=NOISE):
    """A motion of five sines per joint, slow enough that friction shows, while gears warm up from 20 to 45 °C."""
    random, w = np.random.default_rng(seed), np.arange(1.0, 6.0)
    t = 0.025 * np.arange(SAMPLES)
    sizes, phases = 0.7 * random.normal(size=(2, 5)) / w, random.uniform(0, 2 * np.pi, (2, 5))
    q, qd, qdd = sums_of_sines(t, sizes, w, phases)
    temperature = np.stack([20 + 25 * (1 - np.exp(-t / 8))] * 2, axis=1)
    tau = np.asarray(plant(extra)(q, qd, qdd, temperature)) + noise * random.normal(size=q.shape)
    state = {"q": q, "qd": qd, "qdd": qdd, "tau": tau, "temperature": temperature}
    return from_arrays({"t": t, "trajectory": np.zeros(SAMPLES, int), **state})


@pytest.mark.parametrize("case", ["stribeck", "load"])
def test_shapes_and_coefficients_are_found_within_their_errors(case):
    true = {name: value for name, value in SHAPES[case].items() if name != "friction"}
    laws = SHAPES[case]["friction"]
    fit = fit_friction(ARM, log_of(case, noise=0.01), laws, noise=1.0)
    assert fit.solution.converged
    # The mean square of noise over 2 joints, less what the fit takes.
    assert fit.torque_mse == pytest.approx(2 * 0.01**2, rel=0.15)
    found = {**fit.parameters._asdict(), **fit.shape}
    errors = {**fit.standard_errors._asdict(), **fit.shape_errors}
    deviations = []
    for name, value in {**{name: COEFFICIENTS[name] for name in laws if name in COEFFICIENTS}, **true}.items():
        assert (np.asarray(errors[name]) < 0.1 * np.abs(value) + 0.01).all(), name
        deviations.append((np.asarray(found[name]) - value) / errors[name])
    assert np.sqrt(np.mean(np.square(deviations))) < 2 and np.abs(deviations).max() < 4.5


def test_what_is_held_stays():
    data, shape = log_of("stribeck", noise=0.01), FrictionShape(velocity_scale=0.02)
    fit = fit_friction(ARM, data, (*LAWS, "stribeck"), shape=shape, held=("velocity_scale",), noise=1.0)
    assert set(fit.shape) == {"stribeck_velocity"}
    np.testing.assert_allclose(fit.shape["stribeck_velocity"], [0.2, 0.15], rtol=0.05)


@pytest.mark.slow
def test_cooling_and_coupling_are_found_within_their_errors():
    fit = fit_friction(ARM, log_of("cooling"), LAWS, cooling=True, noise=NOISE)
    off = (fit.shape["cooling"] - np.array([0.02, 0.01])) / fit.shape_errors["cooling"]
    assert np.abs(off).max() < 3.5 and (fit.shape_errors["cooling"] < 2e-3).all()
    # The viscous coefficients are those at the reference, the log's mean temperature.
    factor = np.exp(-np.array([0.02, 0.01]) * (fit.keywords["reference_temperature"] - 25))
    off = (np.asarray(fit.parameters.viscous) - factor * [0.4, 0.3]) / np.asarray(fit.standard_errors.viscous)
    assert np.abs(off).max() < 3.5
    fit = fit_friction(ARM, log_of("coupled"), LAWS, coupled=((0, 1),), noise=NOISE)
    found, error = (float(part.coupling["1_2"]) for part in (fit.parameters, fit.standard_errors))
    assert abs(found - 0.03) < 3.5 * error < 0.01


@pytest.mark.parametrize("extra", ["nothing", "load"])
def test_cross_validation_keeps_the_terms_of_the_plant_and_no_other(extra):
    _, kept, _ = choose_terms(ARM, log_of(extra, 1), Terms(LAWS), CANDIDATES)
    assert kept == [name for name in CANDIDATES if name == extra]


def test_what_is_no_fit_is_refused():
    data = log_of("nothing")
    for laws, options, message in [
        (("coulomb",), {"cooling": True}, "cooling is 1.0, but friction has coulomb; add 'viscous' to it"),
        (("viscous",), {"cooling": True}, "friction by temperature needs temperatures, but the data have none"),
        (("coulomb",), {"noise": 0.0}, "noise is 0.0; expected a positive number"),
    ]:
        with one_line(message):
            fit_friction(ARM, data._replace(temperature=None), laws, **options)
