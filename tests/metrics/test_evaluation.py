"""Metrics on known errors, honest latency, and the report's form."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax import figures
from dln_jax.learning.engine.problem import Progress, one_after_the_other
from dln_jax.mechanics.hamiltonian import legendre
from dln_jax.metrics.errors import errors
from dln_jax.metrics.latency import one_step
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.pendulums import pendulum, two_link_arm
from scripts.reports.predictions import predictions
from scripts.reports.rows import Row, conditions, write_report


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


def test_latency_counts_what_it_says():
    calls = []

    def counted(x):
        calls.append(x)
        return x + 1

    latency = one_step(counted, [(jnp.float64(i),) for i in range(3)], calls=20, warm_up=4)
    assert len(calls) == 25 and set(map(float, calls)) == {0.0, 1.0, 2.0}
    assert 0 < latency.p50_us <= latency.p99_us and latency.compile_seconds > 0


def test_a_report_is_plain_json_and_passes_only_what_meets_its_bound(tmp_path):
    rows = [
        Row("case", "low", 1.0, "s", reference=2.0, bound=1.5),
        Row("case", "high", 1.0, "s", bound=1.5, at_least=True),
        Row("case", "free", float("nan"), ""),
        Row("case", "undefined", float("nan"), "", bound=1.0),
    ]
    write_report(tmp_path / "report.json", rows, conditions(dtype="float32", seeds=[0]))
    report = json.loads((tmp_path / "report.json").read_text())
    assert [row["pass"] for row in report["rows"]] == [True, False, None, False]
    assert list(report["rows"][0]) == ["case", "quantity", "value", "unit", "reference", "bound", "pass"]
    assert report["rows"][2]["value"] is None
    assert {"machine", "versions", "dtype", "threads", "seeds", "command"} <= set(report["conditions"])


def test_a_training_figure_has_every_stage_with_its_name_and_a_line_where_it_ends():
    def stage(name, steps):
        return [Progress(step, 1.0 / step, 2.0 / step, float("nan"), 0.0, name) for step in steps]

    for first, rotation in ((range(1, 6), 0.0), ([1], 90.0)):
        history = one_after_the_other([stage("rates", first), stage("motions", range(5, 11, 5))])
        (axis,) = figures.training_curve(history, best_step=history[-1].step).axes
        names = [(text.get_text(), text.get_rotation()) for text in axis.texts]
        assert names == [("rates", rotation), ("motions", rotation)]
        drawn = [line.get_xdata() for line in axis.lines]
        assert any(np.array_equal(x, [len(first)] * 2) for x in drawn)
        # Training and validation of each stage: no curve crosses the line.
        curves = [x for x in drawn if x[0] != x[-1] or len(x) == 1]
        assert all(max(x) <= len(first) or min(x) > len(first) for x in curves) and len(curves) == 4
