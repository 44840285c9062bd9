"""Own files with momenta: published protocols made by numpy and scipy, trained by the command that a user types."""

from pathlib import Path

import numpy as np
import pytest
from calls import command, exit_status, json_of, refused
from numpy.testing import assert_allclose
from published_motions import PUBLISHED, published_arrays

from dln_jax import Needs, load
from dln_jax.commands import train_hnn, train_hnn_task
from dln_jax.commands.phase_spaces.data import MEASURED, TASKS, read_motions
from dln_jax.commands.phase_spaces.models import description_of

TASK = "--task measured --no-figures --data"
SLIDING = Needs(joints=("prismatic",))


@pytest.fixture(scope="module")
def files(folder):
    np.savez("spring.npz", **published_arrays("spring", 11, trajectories=24))
    np.savez("orbits.npz", **published_arrays("two-body", 11, trajectories=24))
    return folder


def own(name, **stated):
    return read_motions(MEASURED, Path(f"{name}.npz").absolute(), needs=SLIDING, **stated)


def test_noise_of_states_and_rates_weighs_motions(files):
    """Own data show what the named task states: sd 0.1 of q and p, and exact rates."""
    log = own("spring")
    weights, named = log.weights, TASKS["spring"].weights
    assert not log.free_of_noise and named.rate == 0.01
    assert_allclose(weights.state, 0.1, rtol=0.15)
    assert_allclose(log.state_noise, 0.1, rtol=0.15)
    assert np.all(np.abs(np.log2(np.divide(weights.rate, named.rate))) < 1)


def test_noise_that_nobody_measured_is_none(files):
    """An exact, coarse file of q alone has noise neither of q nor of p."""
    t = np.arange(0, 20, 0.25)
    q = np.cos(4 * t + np.arange(6)[:, None]).reshape(-1, 1)
    np.savez("coarse.npz", t=np.tile(t, 6), q=q, trajectory=np.repeat(np.arange(6), len(t)))
    log = own("coarse")
    assert not log.state_noise.any() and "p" in log.fitted.estimated


def test_stated_noise_is_used_or_refused(files, capsys):
    one, two = (own("spring", noise=noise).weights for noise in ((0.3,), (0.3, 0.2)))
    assert two.state == (0.3, 0.2) and one.state == (0.3, pytest.approx(0.1, rel=0.15))
    line = refused(capsys, train_hnn_task, TASK, "spring.npz", "--noise 0.1,0.1,0.1 --out none")
    assert "noise has 3 numbers; expected one, or one for each of 1 coordinates, or 2 of q and then p" in line
    # A file without torques names the command for it.
    line = refused(capsys, train_hnn, "--data spring.npz --out none")
    assert "spring.npz: column tau is missing" in line and "train_hnn_task --task measured --data spring.npz" in line


def test_a_file_without_rates_of_momenta_is_no_mass_of_one(files):
    """p = ½ qd on this spring: the rate of p is estimated from p, and is not qdd."""
    arrays = dict(np.load("spring.npz"))
    arrays.pop("pd")
    np.savez("momenta.npz", **arrays)
    log = own("momenta")
    assert "pd" in log.fitted.estimated and np.isinf(log.weights.rate[1])


def test_own_orbits_axis_by_axis_need_no_motions(files, capsys):
    """Nothing is stated: order, bodies and model are found, and rates of other starts are exact."""
    command(train_hnn_task, TASK, "orbits.npz", "--out orbits --steps 25")
    out = capsys.readouterr().out
    assert "auto: pairwise-hnn" in out and "no fit to motions is needed" in out and "motions: loss" not in out
    run = load(files / "orbits")
    assert (run.description["order"], run.description["dimension"], run.description["alike"]) == ("axes", 2, True)
    system = PUBLISHED["two-body"]
    start = system.start(np.random.default_rng(5))
    assert_allclose(run.flow.rates(*start), system.rates(*start), atol=1e-4)
    assert json_of(files / "orbits/metrics.json")["validation_error"] < 1e-9


def test_order_that_forces_do_not_show_is_asked_for(files, capsys):
    arrays = published_arrays("two-body", 11, trajectories=6)
    pd = np.random.default_rng(0).normal(size=arrays["pd"].shape)
    np.savez("shuffled.npz", **{**arrays, "pd": pd})
    still = ("--needs", '{"joints": ["prismatic", "prismatic", "prismatic", "prismatic"]}', "--out", "none")
    line = refused(capsys, train_hnn_task, TASK, "shuffled.npz", "--model pairwise-hnn", *still)
    assert "state --order bodies (x1, y1, x2, y2) or --order axes" in line
    log = read_motions(MEASURED, files / "orbits.npz")
    assert description_of(log, "pairwise-hnn", order="bodies")["order"] == "bodies"


def test_a_model_whose_motions_explode_is_refused(files, capsys):
    """The file's forces point away from rest: its rates are fitted exactly, and every predicted motion grows."""
    arrays = published_arrays("spring", 11, trajectories=8)
    np.savez("away.npz", **{**arrays, "pd": -arrays["pd"]})
    still = ("--needs", '{"joints": ["prismatic"]}', "--model polynomial-hamiltonian --degree 2 --out away")
    status = exit_status(train_hnn_task, TASK, "away.npz", *still)
    said = capsys.readouterr()
    assert status == 1 and said.err.startswith("error: the fit is refused: ")
    assert "verdict: refused: 1 of 1 predicted test motions grow beyond 10 times the range" in said.out
    assert json_of(files / "away/metrics.json")["verdict"] == 2
