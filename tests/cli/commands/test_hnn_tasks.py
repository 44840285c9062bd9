"""Hamiltonian tasks: their report and train_hnn_task end to end on tiny budgets, and what they refuse."""

import json

import numpy as np
import pytest
from calls import assert_refused, command, json_of, refused
from motions import quick_motion
from safetensors.numpy import load_file

from dln_jax.cli.arguments import arguments_of
from dln_jax.cli.commands import train_hnn, train_hnn_task
from dln_jax.cli.stored_arguments import stored_arguments
from dln_jax.data import schema
from dln_jax.learning.engine.optimisers import Adam, GaussNewton
from dln_jax.mechanics.dynamics import Flow
from dln_jax.mechanics.equations import Energies, hamiltonian_of
from dln_jax.metrics.phase_space import Motions
from dln_jax.scenes.datasets import phase_samples
from dln_jax.training.hamiltonian import measurements, predictions, stages
from dln_jax.training.hamiltonian import model_selection as choice
from dln_jax.training.hamiltonian import pixels as pixel_task
from dln_jax.training.hamiltonian import tasks as hnn_tasks
from dln_jax.training.hamiltonian import training as hnn_models
from dln_jax.training.hamiltonian.model_selection import description_of
from dln_jax.training.hamiltonian.tasks import pieces, problem_of
from dln_jax.training.hamiltonian.training import RECIPES
from dln_jax.types import InputError
from dln_jax.zoo.run import load
from scripts.reports import hamiltonian
from scripts.reports.cases import hnn

MEASURED = {
    "spring": ("polynomial-hamiltonian",),
    "pendulum": ("phase-network",),
    "real-pendulum": ("separable-hnn",),
    "two-body": ("black-box-hnn",),
    "three-body": ("pairwise-hnn",),
}
"""Each kind of model on one task at least; a program of each takes seconds to compile."""


def quick_prediction(model, parameters, q, p, t):
    energies = model.energies(parameters)
    return (
        Motions(t, *quick_motion(hamiltonian_of(energies), q, p, t, dissipation=energies.dissipation))
        if isinstance(energies, Energies)
        else Motions(t, *(np.tile(state[:, None], (1, len(t), 1)) for state in (q, p)))
    )


def quick_training(problem, description, **options):
    """By Adam where rates are matched, whose programs compile sooner."""
    optimiser = GaussNewton() if problem.name == hnn_tasks.REAL else Adam()
    return hnn_models.train(problem, description, optimiser=optimiser, **options)


def quick_pixels(kind):
    """The pictures have tests of their own; here, what the table does with their numbers."""
    numbers = dict.fromkeys(("energy_mse", "rollout_mse", "compile_seconds", "parameters", "test_loss"), 2.0)
    return {**numbers, "energy_mse": 1e-5 if kind == "black-box-hnn" else 1e-3, "train_seconds": 1.0}


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A damped pendulum with gaps in place of the measured one, and recipes that take a moment."""
    folder = tmp_path_factory.mktemp("tasks")
    t = np.arange(160) / 6
    t[40:] += 1 / 6
    q = (2 * np.exp(-0.02 * t) * np.cos(2 * t))[:, None]
    schema.save(folder / "swing.npz", schema.from_arrays({"t": t, "q": q, "trajectory": np.zeros(160)}))
    small = {
        name: recipe._replace(
            width=2, depth=1, network=3, network_depth=1, window=6, substeps=1,
            trajectory_steps=int(name in (hnn_tasks.REAL, hnn_tasks.MEASURED)),
        )
        for name, recipe in RECIPES.items()
    }  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for module in (hnn_models, stages, choice):
            patch.setattr(module, "RECIPES", small)
        for module in (hnn_tasks, measurements):
            patch.setattr(module, "WINDOW", dict.fromkeys(hnn_tasks.WINDOW, 6))
        patch.setattr(hnn_tasks, "HORIZONS", dict.fromkeys(hnn_tasks.HORIZONS, 0.5))
        patch.setattr(hamiltonian, "models_of", MEASURED.get)
        patch.setattr(predictions, "predict", quick_prediction)
        patch.setattr(hamiltonian, "train", quick_training)
        for module in (phase_samples, hnn_tasks):
            patch.setattr(module, "reference_motion", quick_motion)
        patch.setattr(hnn_tasks, "STARTS", 2)
        patch.setattr(hnn_tasks, "POINTS", 4)
        patch.setattr(choice, "DEGREES", (2, 3))
        patch.setattr(pixel_task, "measure_pixels", lambda kind, data, **options: (quick_pixels(kind), None))
        patch.setattr(pixel_task, "figures_of", lambda seen, data: {})
        patch.setattr(pixel_task, "pixel_data", lambda *options: None)
        yield folder


@pytest.mark.slow
def test_every_task_is_measured(workplace):
    few = {"seeds": 1, "steps": 1}
    numbers = dict(hamiltonian.real_pendulum(real_pendulum=workplace / "swing.npz", **few))
    for task in set(MEASURED) - {hnn_tasks.REAL}:
        numbers |= hamiltonian.phase_task(task=task, trajectories=10, **few)
    for task, kinds in MEASURED.items():
        for kind in kinds:
            quantities = set(numbers[f"{task}/{kind}"])
            assert {"energy_mse", "rollout_mse", "train_seconds", "compile_seconds", "parameters"} <= quantities
            if task != hnn_tasks.REAL:
                assert {"test_loss", "train_loss", "clean_field_mse", "energy_mse_standard_error"} <= quantities
    # The polynomial holds the oscillator.
    assert numbers["spring/polynomial-hamiltonian"]["clean_field_mse"] < 0.1
    assert "published_energy_mse" in numbers["pendulum/phase-network"]


def test_bounds_are_those_of_the_model_that_suits_the_scene(workplace):
    images = hamiltonian.images(seeds=1)
    assert images["pixels/black-box-hnn"]["energy_mse_over_baseline"] == pytest.approx(1e-2)
    suited = {task: model for task, (model, _) in hnn.BOUNDS.items()}
    assert suited == {task: RECIPES[task].suits for task in suited if task in RECIPES} | {"pixels": "black-box-hnn"}
    assert suited.keys() == hnn.PUBLISHED.keys()
    assert set(RECIPES) == set(hnn_tasks.TASKS)
    assert hamiltonian.real_pendulum() == {}


def test_a_folder_without_files_is_refused(workplace):
    with pytest.raises(InputError, match="has no files such as"):
        hamiltonian.own_files(own=workplace, tasks=("two-body",))


def test_measured_motions_are_cut_at_gaps(workplace):
    problem = problem_of(hnn_tasks.REAL, data=workplace / "swing.npz")
    fitted = problem.fitted
    steps = np.diff(fitted.t)[np.diff(fitted.trajectory) == 0]
    assert steps.max() < 0.2 and len(np.unique(fitted.trajectory)) > 2
    # A fifth of the samples is the test, predicted from its first state.
    assert problem.truth[0].q.shape == (1, 32, 1) and len(fitted.t) == 128 and problem.truth[0].t[0] == 0
    np.testing.assert_array_equal(fitted.p, fitted.qd)
    assert len(np.unique(pieces(fitted, 100).trajectory)) == len(np.unique(fitted.trajectory))


def test_mistakes_are_one_line(workplace, capsys):
    two = schema.load("swing.npz")
    schema.save("double.npz", two._replace(q=np.hstack([two.q, two.q]), estimated=("qd", "qdd", "tau")))
    for name, message in (("delan", "model is 'delan'; this release knows"), ("feed-forward", "is of no phase space")):
        with pytest.raises(InputError, match=message):
            description_of(problem_of(hnn_tasks.REAL, data=workplace / "swing.npz"), name)
    with pytest.raises(InputError, match="has 2 coordinates"):
        hamiltonian.real_pendulum(real_pendulum=workplace / "double.npz")
    with pytest.raises(InputError, match="trajectories is 3"):
        hamiltonian.phase_task(task="two-body", trajectories=3)


@pytest.fixture(scope="module")
def positions(workplace):
    """Six swings with q alone, two with a gap."""
    t = np.arange(40) * 0.1
    parts = [(np.delete(t, range(15, 18)) if number < 2 else t) for number in range(6)]
    q = [np.cos(2 * part + number) for number, part in enumerate(parts)]
    index = np.repeat(np.arange(6), [len(part) for part in parts])
    np.savez("positions.npz", t=np.concatenate(parts), q=np.concatenate(q)[:, None], trajectory=index)
    forced = {"q": np.cos(t)[:, None], "tau": np.ones((40, 1))}
    np.savez("forced.npz", t=t, trajectory=np.zeros(40), **forced)
    marked = np.where(np.arange(120)[:, None] == 9, 1e308, np.cos(np.arange(120.0))[:, None])
    same = {"t": np.tile(t, 3), "trajectory": np.repeat(range(3), 40)}
    np.savez("marked.npz", q=marked, qd=marked, qdd=marked, **same)
    alone = np.random.default_rng(0).normal(size=(12, 1))
    np.savez("points.npz", q=alone, qd=alone, qdd=alone, t=np.zeros(12), trajectory=np.arange(12))
    return workplace / "positions.npz"


OWN = "--task measured --data positions.npz --no-low-latency"
SLIDING = ("--needs", '{"joints": ["prismatic"]}')


@pytest.mark.slow
def test_own_positions_train_and_resume_to_the_same_model(positions, capsys, monkeypatch):
    """A recipe's time is that of the table: it does not end the fit."""
    slow = {name: recipe._replace(seconds=1e-6) for name, recipe in hnn_models.RECIPES.items()}
    monkeypatch.setattr(hnn_models, "RECIPES", slow)
    command(train_hnn_task, OWN, *SLIDING, "--optimizer adam --steps 2 --no-figures --out whole")
    out = capsys.readouterr().out
    assert "finite differences" in out and "out of time" not in out
    assert "2/2 steps  rates: loss" in out and "2/2 steps  motions: loss" in out
    folder = positions.parent / "whole"
    metrics = json_of(folder / "metrics.json")
    assert {"rollout_mse", "train_seconds", "one_step_p50_us", "validation_error"} <= set(metrics)
    assert "energy_mse" not in metrics
    stored = load_file(folder / "model.safetensors")
    for name in ("model.json", "model.safetensors", "metrics.json"):
        (folder / name).unlink()
    command(train_hnn_task, "--out", str(folder), "--resume --no-figures --no-low-latency")
    again = load_file(folder / "model.safetensors")
    assert set(again) == set(stored) and all(np.array_equal(again[key], stored[key]) for key in stored)
    field = load(folder).flow
    assert isinstance(field, Flow)
    qd, pd = field.rates(np.ones(1), np.ones(1))
    assert np.isfinite(qd).all() and np.isfinite(pd).all()


def test_what_a_task_does_not_take_is_one_line(positions, capsys):
    rows = [
        ("--task juggling", "task 'juggling' is unknown"),
        ("--task pixels", "task 'pixels' is unknown"),
        ("--task measured", "needs its data"),
        ("--task measured --data forced.npz", "applied forces"),
        ("--task measured --data marked.npz", "q has numbers of up to 1.0e+308"),
        ("--task measured --data points.npz", "no trajectory has two samples"),
        ("--task spring --data positions.npz", "--data is an option of --task measured"),
        ("--task spring", *SLIDING, "--needs is an option of --task measured"),
        (OWN, "--needs", "{", "--needs is not JSON"),
        (OWN, "--needs", '{"joints": ["revolute", "revolute"]}', "have 2 joints"),
    ]
    assert_refused(capsys, train_hnn_task, rows, out=positions.parent / "none")
    others = ("precision f32", "seeds 3", "target 1e-6", "batch -1", "patience 4", "weight-decay 0.1")
    rows = [
        *((f"--{option}", f"unrecognised option: --{option.split()[0]}") for option in others),
        ("--model pairwise-hnn", "positions of bodies"),
        ("--steps 0", "steps is 0"),
        ("--seed -1", "seed is -1"),
        ("--seconds nan", "--seconds is nan"),
        ("--learning-rate 0.1", "an option of --optimizer adam"),
        ("--optimizer adam --learning-rate nan", "--learning-rate is nan"),
        ("--degree 3", "--degree is an option of --model polynomial-hamiltonian"),
        ("--model polynomial-hamiltonian --width 3", "--width is an option of networks"),
        ("--trajectories 3", "--trajectories is an option of tasks that generate their data"),
    ]
    assert_refused(capsys, train_hnn_task, rows, OWN, *SLIDING, out=positions.parent / "none")


def test_options_and_models_of_other_commands_are_refused(positions, capsys):
    rows = [
        ("--model baseline", "--model is 'baseline'"),
        ("--trajectories 5", "unrecognised option: --trajectories"),
    ]
    assert_refused(capsys, train_hnn, rows, out=positions.parent / "none")
    old = positions.parent / "old"
    old.mkdir()
    (old / "config.json").write_text(
        json.dumps({**stored_arguments(arguments_of(train_hnn.Arguments)), "task": "spring"})
    )
    assert "'task' is not an argument of this release" in refused(capsys, train_hnn, "--out", str(old), "--resume")


@pytest.mark.slow
def test_out_of_time_the_fit_of_rates_is_the_result(positions, capsys):
    """In a folder like any other."""
    options = (OWN, *SLIDING, "--optimizer adam --steps 2 --no-figures --seconds 1e-6")
    command(train_hnn_task, *options, "--out hurried")
    assert "out of time after the fit of rates: motions were not fitted" in capsys.readouterr().out
    assert np.isfinite(json_of(positions.parent / "hurried" / "metrics.json")["validation_error"])
    assert isinstance(load(positions.parent / "hurried").flow, Flow)
