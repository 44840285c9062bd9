"""Every model and optimiser through the command line, on a pendulum and a tiny budget."""

import re

import numpy as np
import pytest
from calls import command, json_of

from dln_jax import load
from dln_jax.commands import train_delan, train_hnn
from dln_jax.data import schema
from dln_jax.learning.engine.optimisers import suited
from dln_jax.learning.fits import network
from dln_jax.mechanics.dynamics import InverseForward
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.pendulums import pendulum

BRIEF = "--no-figures --no-uncertainty"
QUICK = f"--data swing.npz --width 3 --depth 1 --steps 6 {BRIEF}"


@pytest.fixture(scope="module")
def workplace(folder):
    """A folder with a small data file of a driven, damped pendulum: momenta, and needs that the file states."""
    scene = pendulum(friction=0.2)
    data = generators.uniform(scene, samples=120, rate_bound=3.0, acceleration_bound=5.0)
    schema.save(folder / "swing.npz", data)
    schema.save(folder / "bare.npz", data._replace(p=None, pd=None))
    return folder


def metrics_of(folder):
    return json_of(folder / "metrics.json")


def test_a_learned_tree_is_searched_for_and_is_exact(workplace, capsys):
    options = "--data swing.npz --model learned-tree --no-figures"
    command(train_delan, options, "--out tree")
    assert "starts reached" in capsys.readouterr().out
    assert metrics_of(workplace / "tree")["torque_mse"] < 1e-12
    assert load(workplace / "tree").description["name"] == "learned-tree"


def test_a_kernel_is_made_of_samples_and_its_order_is_chosen_by_validation(workplace, capsys):
    options = "--data swing.npz --model trigonometric-kernel --no-figures"
    command(train_delan, options, "--samples 40 --out kernel")
    said = capsys.readouterr().out
    assert re.search(r"kernel: 40 of \d+ samples", said) and "by order of the bodies: a chain: " in said
    assert metrics_of(workplace / "kernel")["torque_mse"] < 1e-4
    assert load(workplace / "kernel").description["samples"] == 40


@pytest.mark.as_users_compile
def test_the_trigonometric_model_is_exact(workplace, capsys):
    command(train_delan, "--data swing.npz --model trigonometric --no-figures --out linear")
    metrics = metrics_of(workplace / "linear")
    assert metrics["torque_mse"] < 1e-20 and metrics["one_step_p50_us"] > 0 and metrics["share_not_definite"] == 0
    assert "least squares: 6 parameters, rank" in capsys.readouterr().out
    tau = load("linear").dynamics.inverse_dynamics([0.5], [1.0], [2.0])
    # m l² qdd + m g l sin q + b qd
    np.testing.assert_allclose(tau, [2.0 + 9.81 * np.sin(0.5) + 0.2], rtol=1e-9)


def test_auto_takes_gauss_newton_for_a_small_network_and_several_seeds_give_their_spread(workplace, capsys):
    command(train_delan, QUICK, "--seeds 2 --out seeds")
    metrics = metrics_of(workplace / "seeds")
    assert metrics["torque_mse_largest"] >= metrics["torque_mse_median"] > 0
    assert metrics["torque_mse_standard_deviation"] > 0
    assert metrics["parameters"] == 2 * (2 * 3 + 3 + 3 + 1) + 1
    out = capsys.readouterr().out
    assert "gauss-newton (27 parameters: the normal equations take" in out
    assert "cross-validated errors by seed, 3 folds: 0: " in out and "the best by cross-validation" in out
    assert suited(np.zeros(10_000), 100, 1)[0] == "adam"


def test_black_box_models_report_their_mass_matrix(workplace, capsys):
    brief = (QUICK, "--model")
    command(train_delan, *brief, "black-box-delan", "--out black-box")
    metrics = metrics_of(workplace / "black-box")
    assert 0 <= metrics["share_not_definite"] <= 1 and "smallest_mass_eigenvalue" in metrics
    command(train_delan, *brief, "feed-forward", "--out feed-forward")
    assert isinstance(load(workplace / "feed-forward").dynamics, InverseForward)


def test_hamiltonians_are_fitted_to_momenta_or_torques(workplace, capsys):
    command(train_hnn, QUICK, "--out hamiltonian")
    assert "structured-hnn" in capsys.readouterr().out
    assert np.isfinite(load(workplace / "hamiltonian").flow.energy([1.0], [1.0]))
    command(train_hnn, QUICK, "--data bare.npz --out bare")
    assert "no momenta p in the data" in capsys.readouterr().out


def test_a_target_grows_the_network_and_lists_every_candidate(workplace, capsys, monkeypatch):
    monkeypatch.setattr(network, "WIDTHS", (2,))
    monkeypatch.setattr(network, "DEPTHS", (1,))
    command(train_delan, "--data swing.npz --steps 2", BRIEF, "--target 1e-30 --out hard")
    assert "no candidate meets 1e-30; the most accurate one is kept" in capsys.readouterr().out
    candidates = json_of(workplace / "hard/selection.json")["candidates"]
    assert [each["name"] for each in candidates] == ["1 x 2, one network", "1 x 2, two networks"]
    best = min(candidates, key=lambda each: each["validation_error"])
    assert metrics_of(workplace / "hard")["parameters"] == best["parameters"]


def test_a_table_has_the_plant_beside_the_model(workplace, capsys):
    data = generators.free_swing(pendulum(), trajectories=7, steps=40)
    torque = np.random.default_rng(0).normal(size=data.tau.shape)
    data = data._replace(tau=data.tau + 1e-3 * torque)
    schema.save("swings.npz", data)
    options = ("--width 3 --depth 1 --steps 2", BRIEF, "--scene pendulum --data")
    command(train_delan, *options, "swings.npz", "--out swings")
    out = capsys.readouterr().out
    assert "true plant" in out and re.search(r"valid prediction time, torque held +│ +[\d.]+ │ +[\d.]+ │ s", out)
