"""A value function from the shell: trained, stored, loaded, and what is refused."""

import jax.numpy as jnp
import numpy as np
import pytest
from calls import assert_refused, command, json_of

from dln_jax.commands import train_value
from dln_jax.zoo.run import load

TINY = "--method residual --width 3 --depth 1 --iterations 1 --starts 3"


def test_a_run_is_stored_and_comes_back(tmp_path, capsys):
    command(train_value, TINY, "--goal 0.2 --out", tmp_path / "run")
    numbers = json_of(tmp_path / "run/metrics.json")
    assert numbers["validation"] > 0 and numbers["down_control_most"] <= 2.5
    run = load(tmp_path / "run").value
    goal = jnp.array([0.2, 0.0])
    assert run.value_and_gradient(goal)[0] == 0 and np.isnan(run.law(goal * jnp.nan)).all()
    np.testing.assert_allclose(run.law(goal), -9.81 / 2 * np.sin(0.2), rtol=1e-9)
    command(train_value, "--stored", tmp_path / "run", "--starts 3 --out", tmp_path / "again")
    again = json_of(tmp_path / "again/metrics.json")
    assert again["down_return_mean"] == pytest.approx(numbers["down_return_mean"])
    rows = [("--goal 0.1", "--goal is an option of a training, without --stored")]
    assert_refused(capsys, train_value, rows, "--stored", tmp_path / "run", out=tmp_path / "other")


def test_mistakes_are_one_line_and_leave_nothing(tmp_path, capsys):
    rows = {
        "--plant unicycle": "plant is 'unicycle'; choose from cart-pole, pendulum",
        "--method guess": "choose from fitted, residual",
        "--goal 1.2": "the limits are [2.5]",
        "--plant cart-pole --goal 0,0.5": "no equilibrium near the goal",
        "--goal 0,0": "expected a number, or 1 numbers",
        "--goal up": "expected finite numbers",
        "--stored /nowhere": "no such file",
    }
    assert_refused(capsys, train_value, rows.items(), out=tmp_path / "run")
