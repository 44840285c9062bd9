"""Shapes of friction curves are found with the inertias, from torque with noise, within the stated errors."""

import functools

import jax
import numpy as np
import pytest

from dln_jax.data.schema import from_arrays
from dln_jax.learning.friction import fit_friction
from dln_jax.mechanics import trees
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import FrictionShape, joint_dissipation
from dln_jax.mechanics.joint_friction import Load, with_friction
from dln_jax.types import InputError

LINK = trees.inertial_parameters(2.0, [0.05, 0.02, 0.1], np.diag([0.02, 0.03, 0.01]))
ARM = trees.serial(*trees.dh_frames([[0, 0, 0.3, 0], [-np.pi / 2, 0.1, 0, 0]]), [LINK] * 2, armature=[0.1, 0.05])
NOISE, SAMPLES = 0.01, 600
DRY = {"viscous": [0.3, 0.2], "coulomb": [0.5, 0.4], "offset": [0.02, -0.03], "velocity_scale": 0.02}
CASES = {
    "stribeck": ({**DRY, "stribeck": [0.4, 0.3], "stribeck_velocity": [0.2, 0.15]}, None),
    "load": (DRY, [0.2, 0.1]),
    "sigmoid": (
        {"viscous": [0.3, 0.2], "sigmoid": [0.5, 0.4], "sigmoid_slope": [20.0, 8.0], "sigmoid_shift": [0.05, -0.05]},
        None,
    ),
}
LAWS = {
    "stribeck": ("viscous", "coulomb", "offset", "stribeck"),
    "load": ("viscous", "coulomb", "offset", "load"),
    "sigmoid": ("viscous", "sigmoid"),
}


@functools.cache
def torques_of(case):
    """Inverse dynamics of the arm with the friction of a case, compiled once."""
    friction, share = CASES[case]
    system = with_friction(
        trees.tree_system(ARM),
        joint_dissipation(**{key: np.asarray(value) for key, value in friction.items()}),
        None if share is None else Load(np.array(share), 0.02),
    )
    return jax.jit(jax.vmap(dynamics(system).inverse_dynamics))


def log_of(case, seed, noise):
    """A motion of five sines per joint, slow enough that friction shows."""
    random, w = np.random.default_rng(seed), np.arange(1.0, 6.0)[:, None]
    t = 0.01 * np.arange(SAMPLES)
    sizes, phases = 0.5 * random.normal(size=(2, 5, 1)), random.uniform(0, 2 * np.pi, (2, 5, 1))
    q, qd, qdd = (
        np.sum(sizes * wave, axis=1).T
        for wave in (np.sin(w * t + phases) / w, np.cos(w * t + phases), -w * np.sin(w * t + phases))
    )
    tau = np.asarray(torques_of(case)(q, qd, qdd))
    tau = tau + noise * random.normal(size=tau.shape)
    return from_arrays({"t": t, "q": q, "qd": qd, "qdd": qdd, "tau": tau, "trajectory": np.zeros(SAMPLES, int)})


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_shapes_and_coefficients_are_found_within_their_errors(case):
    friction, share = CASES[case]
    true = {**friction, **({} if share is None else {"load": share})}
    fit = fit_friction(ARM, log_of(case, 0, NOISE), LAWS[case], noise=1.0)
    assert fit.converged
    # The mean square of noise over 2 joints, less what the fit takes.
    assert fit.torque_mse == pytest.approx(2 * NOISE**2, rel=0.15)
    deviations = []
    for name, value in true.items():
        found, error = (
            (fit.shape[name], fit.shape_errors[name])
            if name in fit.shape
            else (getattr(fit.parameters, name), getattr(fit.standard_errors, name))
        )
        assert (np.asarray(error) < 0.1 * np.abs(value) + 0.01).all(), name
        deviations.append((np.asarray(found) - value) / error)
    deviations = np.concatenate(deviations)
    assert np.sqrt(np.mean(deviations**2)) < 2 and np.abs(deviations).max() < 4.5
    predicted = jax.jit(jax.vmap(dynamics(fit.model.energies(fit.parameters)).inverse_dynamics))
    unseen = log_of(case, 1, 0.0)
    assert np.mean((predicted(unseen.q, unseen.qd, unseen.qdd) - unseen.tau) ** 2) < NOISE**2


def test_what_is_held_stays():
    fit = fit_friction(
        ARM, log_of("stribeck", 0, NOISE), LAWS["stribeck"],
        shape=FrictionShape(velocity_scale=0.02), held=("velocity_scale",), noise=1.0,
    )  # fmt: skip
    assert set(fit.shape) == {"stribeck_velocity"}
    np.testing.assert_allclose(fit.shape["stribeck_velocity"], [0.2, 0.15], rtol=0.05)


@pytest.mark.parametrize(
    "laws, options, message",
    [
        (("coulomb",), {"cooling": True}, "friction has coulomb, which no temperature changes; add viscous"),
        (("viscous",), {"cooling": True}, "friction is to depend on temperature, which the data do not have"),
        (("coulomb",), {"noise": 0.0}, "noise is 0.0; expected a positive number"),
    ],
)
def test_what_is_no_fit_is_refused(laws, options, message):
    with pytest.raises(InputError, match=message):
        fit_friction(ARM, log_of("stribeck", 0, 0.0), laws, **options)
