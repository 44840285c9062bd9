"""The table of all models of the arm: its bookkeeping with training stubbed, and one model measured for real."""

import json

import numpy as np
import pytest
from test_train_delan import command, refused

from dln_jax.data import generators, schema
from dln_jax.scenes.pendulum import pendulum
from scripts import arm_models, arm_table
from scripts.arm_published import COLUMNS, PUBLISHED, published

NUMBERS = {
    **{f"{name}_mse": 1e-7 for name in ("torque", "inertial", "coriolis", "gravity")},
    **{"vpt_seconds": 3.0, "train_seconds": 4.0, "parameters": 260.0, "one_step_p50_us": 12.0},
}


@pytest.fixture
def stubbed(tmp_path, monkeypatch):
    """Every measurement replaced by the same numbers; counts them."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    calls = []

    def measure(*arguments, **keywords):
        calls.append(arguments)
        return NUMBERS, arm_models.Curve([1.0, 4.0], [1e-3, 1e-7])

    for name in ("measure_seeds", "measure_trigonometric", "measure_adam"):
        monkeypatch.setattr(arm_table, name, measure)
    monkeypatch.setattr(arm_table, "plant_rows", lambda scene, sets: ({"vpt_seconds": 3.1}, None))
    monkeypatch.setattr(arm_table, "gauss_newton_rows", lambda *a, **k: ({"seconds_to_1e-08": 21.0}, None))
    return calls


def test_every_published_number_has_a_row_with_a_bound(stubbed, tmp_path, capsys):
    command(arm_table, "--out", "table")
    report = json.loads((tmp_path / "table" / "report.json").read_text())
    rows = {(row["case"], row["quantity"]): row for row in report["rows"]}
    for kind, datasets in PUBLISHED.items():
        for dataset, values in datasets.items():
            for quantity, value in zip(COLUMNS[dataset], values, strict=True):
                row = rows[f"{kind}/{dataset}", quantity]
                assert row["reference"] == value == published(kind, dataset, quantity)
                assert row["bound"] is not None or quantity == "vpt_seconds"
    assert rows["structured-delan/characters", "torque_mse"]["bound"] == pytest.approx(2.2e-7)
    assert rows["black-box-delan/characters", "torque_mse"]["bound"] == 2.8e-5
    # 98 % of the plant's 3.1 s are 3.04 s.
    assert rows["structured-hnn/uniform", "vpt_seconds"]["pass"] is False
    assert rows["structured-delan/characters/gauss-newton", "seconds_to_1e-08"]["pass"] is False
    assert rows["trigonometric/characters", "torque_mse"]["pass"] is False
    assert rows["feed-forward/uniform", "torque_mse"]["pass"] is True
    lines = (tmp_path / "table" / "table.md").read_text().splitlines()
    assert sum(line.startswith("| ") for line in lines) == 1 + len(PUBLISHED) + 1
    assert "1.0e-07 / 5.4e-06" in next(line for line in lines if line.startswith("| structured-hnn"))
    assert (tmp_path / "table" / "pareto.png").read_bytes().startswith(b"\x89PNG")
    # A table that is continued measures nothing twice.
    measured = len(stubbed)
    command(arm_table, "--out", "table", "--resume")
    assert len(stubbed) == measured == 2 + 2 * len(PUBLISHED) + len(PUBLISHED)


def test_data_of_another_plant_is_refused(stubbed, tmp_path, capsys):
    schema.save(tmp_path / "pendulum.npz", generators.uniform(pendulum(), samples=20))
    for option in ("--data", "--uniform"):
        assert "that of the two-link arm" in refused(capsys, arm_table, option, "pendulum.npz", "--out", "no")
    assert "seeds is 0" in refused(capsys, arm_table, "--seeds", "0", "--out", "no")
    assert not (tmp_path / "no").exists()


def test_the_trigonometric_model_and_the_plant_are_measured(tmp_path):
    """The plant along its own free swings, and the linear model, which is as good."""
    sets = arm_table.states(None, samples=60)
    assert len(sets.validation.t) == 6 and len(np.unique(sets.test.trajectory)) == 3
    numbers, curve = arm_models.measure_trigonometric(sets)
    assert numbers["torque_mse"] < 1e-20 and numbers["noisy_torque_mse"] < 1e-2
    assert curve.errors == [numbers["torque_mse"]] or curve.errors == [1e-32]
    plant, _ = arm_models.plant_rows(arm_table.two_link_arm(), sets)
    assert numbers["vpt_seconds"] == pytest.approx(plant["vpt_seconds"])
    # What the published motions give, which symplectic Euler made; those of the hanging arm would give 6.62 s.
    assert plant["vpt_seconds"] == pytest.approx(6.467, abs=0.01)
