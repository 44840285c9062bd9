"""Metrics on known errors, honest latency, and the report's form."""

import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.figures.training import training_curve
from dln_jax.learning.engine.problem import Progress
from dln_jax.mechanics.hamiltonian import legendre
from dln_jax.metrics.errors import errors
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.pendulums import pendulum, two_link_arm
from scripts.reports.arm.data import predictions


def test_errors_are_sums_over_joints_and_means_over_samples():
    data = generators.uniform(two_link_arm(), samples=50)
    predicted = predictions(two_link_arm().energies, data, jnp.float64)
    exact = errors(predicted, data)
    assert set(exact) == {f"{k}_mse" for k in ("torque", "forward", "power", "inertial", "coriolis", "gravity")}
    assert max(exact.values()) < 1e-20, "the textbook makes no error"
    off = {**predicted, "tau": predicted["tau"] + np.array([0.3, -0.4]), "qdd": predicted["qdd"] + 2.0}
    result = errors(off, data)
    assert result["torque_mse"] == pytest.approx(0.25)
    assert result["forward_mse"] == pytest.approx(8.0)
    assert result["power_mse"] == pytest.approx(np.mean((data.qd @ [0.3, -0.4]) ** 2))
    without_truth = errors(off, data._replace(tau_gravity=None))
    assert "gravity_mse" not in without_truth and "coriolis_mse" in without_truth


@pytest.mark.slow
def test_torques_from_momenta_are_as_wrong_as_recorded_rates():
    """The true plant, damped: exact momenta give exact torques, and difference quotients their own error."""
    scene = pendulum(friction=0.3)
    data = generators.free_swing(scene, trajectories=1, steps=50)
    quotients = np.gradient(data.p, data.t, axis=0)
    H = legendre(scene.lagrangian)
    exact, wrong, without = (
        errors(predictions(scene.energies, each, jnp.float64, H=H), each)
        for each in (data, data._replace(pd=quotients), data._replace(p=None))
    )
    assert exact["torque_from_momenta_mse"] < 1e-20
    assert wrong["torque_from_momenta_mse"] == pytest.approx(np.mean((quotients - data.pd) ** 2), rel=1e-9)
    assert wrong["torque_from_momenta_mse"] > 1e-6 > 1e-20 > wrong["torque_mse"]
    assert "torque_from_momenta_mse" not in without


def test_a_training_figure_names_every_stage_and_has_a_line_where_it_ends():
    stages = ["rates"] * 5 + ["motions"] * 2
    history = [Progress(step, 1.0 / step, 2.0 / step, np.nan, 0.0, name) for step, name in enumerate(stages, 1)]
    (axis,) = training_curve(history, best_step=7).axes
    assert [text.get_text() for text in axis.texts] == ["rates", "motions"]
    drawn = [(min(x), max(x)) for x in (line.get_xdata() for line in axis.lines)]
    # Training and validation of each stage: no curve crosses the line.
    curves = [ends for ends in drawn if ends[0] < ends[1]]
    assert (5, 5) in drawn and len(curves) == 4 and all(last <= 5 or first > 5 for first, last in curves)
