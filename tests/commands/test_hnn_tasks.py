"""Hamiltonian tasks: the report hnn and train_hnn_task end to end on tiny budgets, and what they refuse."""

import numpy as np
import pytest
from calls import assert_refused, command, json_of
from motions import quick_motion

from dln_jax import load
from dln_jax.commands import train_hnn_task
from dln_jax.commands.phase_spaces import data as phase_data
from dln_jax.commands.phase_spaces import results
from dln_jax.data import schema
from dln_jax.mechanics.dynamics import Flow
from dln_jax.mechanics.equations import hamiltonian_of
from dln_jax.metrics.phase_space import Motions


def quick_prediction(model, parameters, q, p, t):
    H = model.energies(parameters)
    return Motions(t, *quick_motion(hamiltonian_of(H), q, p, t, dissipation=H.dissipation))


@pytest.fixture(scope="module")
def workplace(folder):
    """A damped pendulum with gaps in place of the measured one, and tasks that take a moment."""
    t = np.arange(160) / 6
    t[40:] += 1 / 6
    q = (2 * np.exp(-0.02 * t) * np.cos(2 * t))[:, None]
    schema.save(folder / "swing.npz", schema.from_arrays({"t": t, "q": q, "trajectory": np.zeros(160)}))
    sizes = {"width": 2, "depth": 1, "network": 3, "network_depth": 1, "window": 6, "substeps": 1}
    small = {name: task._replace(**sizes, trajectory_steps=1) for name, task in phase_data.TASKS.items()}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(phase_data, "TASKS", small)
        patch.setattr(results, "predict", quick_prediction)
        yield folder


def test_measured_motions_are_cut_at_gaps(workplace):
    log = phase_data.read_motions(phase_data.REAL, workplace / "swing.npz")
    fitted = log.fitted
    assert np.diff(fitted.t)[np.diff(fitted.trajectory) == 0].max() < 0.2 and len(np.unique(fitted.trajectory)) > 2
    # A fifth of the samples is the test, predicted from its first state.
    assert log.truth[0].q.shape == (1, 32, 1) and len(fitted.t) == 128 and log.truth[0].t[0] == 0
    np.testing.assert_array_equal(fitted.p, fitted.qd)


@pytest.fixture(scope="module")
def positions(workplace):
    """Six swings with q alone, two with a gap; and files that are refused."""
    t, trajectory = np.tile(0.1 * np.arange(40), 6), np.repeat(np.arange(6), 40)
    six = {"t": t, "q": np.cos(2 * t + trajectory)[:, None], "trajectory": trajectory}
    gaps = (trajectory < 2) & (abs(t - 1.6) < 0.15)
    np.savez("positions.npz", **{key: values[~gaps] for key, values in six.items()})
    np.savez("forced.npz", **six, tau=np.ones((240, 1)))
    np.savez("marked.npz", **{**six, "q": np.where(np.arange(240)[:, None] == 9, 1e308, six["q"])})
    np.savez("points.npz", **{**six, "trajectory": np.arange(240)}, qd=six["q"], qdd=six["q"])
    return workplace


OWN = "--task measured --data positions.npz"
SLIDING = ("--needs", '{"joints": ["prismatic"]}')


def test_own_positions_train_and_resume_to_the_same_model(positions, capsys):
    command(train_hnn_task, OWN, *SLIDING, "--optimizer adam --steps 2 --no-figures --out whole")
    out = capsys.readouterr().out
    assert "finite differences" in out
    assert "2/2 steps  rates: loss" in out and "2/2 steps  motions: loss" in out
    metrics = json_of(positions / "whole/metrics.json")
    assert {"rollout_mse", "train_seconds", "validation_error"} <= set(metrics) and "energy_mse" not in metrics
    model = positions / "whole/model.safetensors"
    stored = model.read_bytes()
    model.unlink()
    command(train_hnn_task, "--out whole --resume --no-figures")
    assert model.read_bytes() == stored
    assert np.isfinite(load("whole").flow.rates(np.ones(1), np.ones(1))).all()


def test_what_a_task_does_not_take_is_one_line(positions, capsys):
    rows = [
        ("--task juggling", "task 'juggling' is unknown"),
        ("--task measured", "give it with --data"),
        ("--task measured --data forced.npz", "applied forces"),
        ("--task measured --data marked.npz", "q has numbers of up to 1.0e+308"),
        ("--task measured --data points.npz", "no trajectory has two samples"),
        ("--task spring --data positions.npz", "--data is an option of --task measured"),
        ("--task spring --test a", "--test is an option of --task measured"),
        ("--task spring", *SLIDING, "--needs is an option of --task measured"),
        ("--task spring --model trigonometric", "has no phase space"),
        (OWN, "--needs", '{"joints": ["revolute", "revolute"]}', "has 2 joints"),
        (OWN, "--noise small", "--noise is 'small'"),
        (OWN, "--noise 0", "finite positive numbers"),
        (
            OWN,
            "--coordinates absolute",
            "--coordinates is an option of --model polynomial-hamiltonian or trigonometric or planar-chain",
        ),
    ]
    assert_refused(capsys, train_hnn_task, rows, out=positions / "none")
    rows = {
        "--weight-decay 0.1": "unrecognised option: --weight-decay",
        "--model pairwise-hnn": "prismatic coordinates per body",
        "--steps 0": "steps is 0",
        "--seconds nan": "--seconds is nan",
        "--learning-rate 0.1": "an option of --optimizer adam",
        "--optimizer adam --learning-rate nan": "--learning-rate is nan",
        "--degree 3": "--degree is an option of --model polynomial-hamiltonian",
        "--model polynomial-hamiltonian --width 3": "--width is an option of networks",
        "--trajectories 3": "--trajectories is an option of tasks that generate their data",
    }
    assert_refused(capsys, train_hnn_task, rows.items(), OWN, *SLIDING, out=positions / "none")


def test_out_of_time_the_fit_of_rates_is_the_result(positions, capsys):
    """In a folder like any other."""
    options = "--optimizer adam --steps 2 --no-figures --seconds 1e-6 --out hurried"
    command(train_hnn_task, OWN, *SLIDING, options)
    assert "time was up after the fit to rates; motions were not fitted" in capsys.readouterr().out
    assert np.isfinite(json_of(positions / "hurried/metrics.json")["validation_error"])
    assert isinstance(load("hurried").flow, Flow)
