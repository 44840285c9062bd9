"""The table of all models of the arm: its bookkeeping with training stubbed, and one model measured for real."""

import numpy as np
import pytest
from calls import command, json_of, refused

from dln_jax.data import schema
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.pendulums import pendulum, two_link_arm
from dln_jax.zoo.catalogue import CATALOGUE
from scripts.reports.arm import models as arm_models
from scripts.reports.arm import table
from scripts.reports.arm.table import states
from scripts.reports.commands import arm_table
from scripts.reports.published import ARM

NUMBERS = {
    **{f"{name}_mse": 1e-7 for name in ("torque", "inertial", "coriolis", "gravity", "torque_from_momenta")},
    **{"vpt_seconds": 3.0, "train_seconds": 4.0, "parameters": 260.0, "one_step_p50_us": 12.0},
}
TIMES = {"seconds_to_1e-08": 21.0, "seconds_to_1e-10": np.inf}
"""Times of two runs in turn; an error that was never reached is null in the file, also after a continuation."""


@pytest.fixture
def stubbed(tmp_path, monkeypatch):
    """Every measurement replaced by the same numbers; counts them."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    calls = []

    def measure(*arguments, **keywords):
        calls.append(arguments)
        return NUMBERS

    def measure_split(kind, sets, *, seeds, steps):
        """Errors that grow from one call to the next, the worst seed ten times the median."""
        calls.append(sets.test)
        return {"torque_mse": len(calls) * 1e-9, "torque_mse_largest": len(calls) * 1e-8}

    for name in ("measure_seeds", "measure_trigonometric", "measure_adam"):
        monkeypatch.setattr(table, name, measure)
    monkeypatch.setattr(table, "measure_split", measure_split)
    plant = {"vpt_seconds": 3.1, "whole_circle_torque_mean_square": 70.0}
    monkeypatch.setattr(table, "measure_plant", lambda scene, sets: plant)
    monkeypatch.setattr(table, "measure_one_by_one", lambda *a, **k: TIMES)
    return calls


@pytest.mark.slow
def test_every_published_number_has_a_row_with_a_bound(stubbed, tmp_path, capsys):
    command(arm_table, "--out table")
    report = json_of(tmp_path / "table" / "report.json")
    rows = {(row["case"], row["quantity"]): row for row in report["rows"]}
    for case, values in ARM.values.items():
        # Published Hamiltonian torques are computed from recorded momenta, and compared with ours of that kind.
        by_momenta = CATALOGUE[case.split("/")[0]].properties.canonical
        assert ("torque_from_momenta_mse" in values) == by_momenta != ("torque_mse" in values)
        assert (rows[case, "torque_mse"]["reference"] is None) == by_momenta
        for quantity, value in values.items():
            row = rows[case, quantity]
            assert row["reference"] == value
            assert row["bound"] is not None or quantity == "vpt_seconds"
    assert rows["structured-delan/characters", "torque_mse"]["bound"] == pytest.approx(2.2e-7)
    assert rows["black-box-delan/characters", "torque_mse"]["bound"] == 2.8e-5
    assert rows["structured-hnn/characters", "torque_mse"]["bound"] == pytest.approx(5.4e-8)
    # 98 % of the plant's 3.1 s are 3.04 s.
    assert rows["structured-hnn/uniform", "vpt_seconds"]["pass"] is False
    assert rows["structured-delan/characters/gauss-newton", "seconds_to_1e-08"]["pass"] is False
    assert rows["trigonometric/characters", "torque_mse"]["pass"] is False
    assert rows["feed-forward/uniform", "torque_mse"]["pass"] is True
    lines = (tmp_path / "table" / "table.md").read_text().splitlines()
    assert "1e-07 / 5.4e-06" in next(line for line in lines if line.startswith("| structured-hnn/characters |"))
    # On the other splits every letter is a test once; their median and the worst single run are rows.
    before = 2  # the published data sets come first
    tests = stubbed[before : before + 7]
    letters = [str(test.label[index]) for test in tests for index in np.unique(test.trajectory)]
    assert len(letters) == 20 and set(letters) == set(tests[0].label)
    median, worst = (rows["structured-delan/characters/splits", f"torque_mse_{name}"] for name in ("median", "worst"))
    assert median["value"] == pytest.approx((before + 4) * 1e-9)
    assert worst["value"] == pytest.approx((before + 7) * 1e-8)
    # A table that is continued measures nothing twice.
    measured = len(stubbed)
    command(arm_table, "--out table --resume")
    assert len(stubbed) == measured == 2 + 3 * len(table.WIDTHS) + 7 * len(table.MODELS)
    assert json_of(tmp_path / "table" / "report.json")["rows"] == report["rows"]


def test_data_of_another_plant_is_refused(stubbed, tmp_path, capsys):
    schema.save(tmp_path / "pendulum.npz", generators.uniform(pendulum(), samples=20))
    for option in ("--data", "--uniform"):
        assert "that of the two-link arm" in refused(capsys, arm_table, option, "pendulum.npz", "--out no")
    assert "seeds is 0" in refused(capsys, arm_table, "--seeds 0 --out no")
    assert "20 trajectories cannot be cut into 21 tests" in refused(capsys, arm_table, "--splits 21 --out no")
    assert not (tmp_path / "no").exists()


@pytest.mark.slow
def test_the_trigonometric_model_and_the_plant_are_measured(tmp_path):
    """The plant along its own free swings, and the linear model, which is as good."""
    sets = states(None, samples=60)
    assert len(sets.validation.t) == 6 and len(np.unique(sets.test.trajectory)) == 3
    numbers = arm_models.measure_trigonometric(sets)
    assert numbers["torque_mse"] < 1e-20 and numbers["noisy_torque_mse"] < 1e-2
    assert numbers["whole_circle_torque_mse"] < 1e-20
    plant = arm_models.measure_plant(two_link_arm(), sets)
    assert numbers["vpt_seconds"] == pytest.approx(plant["vpt_seconds"])
    # What the published motions give, which symplectic Euler made; those of the hanging arm would give 6.62 s.
    assert plant["vpt_seconds"] == pytest.approx(6.467, abs=0.01)
    assert plant["torque_from_momenta_mse"] < 1e-20 and 0 < plant["free_motion_inside_seconds"] <= 5
    part = arm_models.measure_split("trigonometric", sets, seeds=1, steps=None)
    assert part["torque_mse"] == part["torque_mse_largest"] < 1e-20
