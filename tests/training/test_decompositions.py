"""Parts of a torque: those that data determine are right by default, and a run says which are known only in sum."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import command, json_of
from motions import sums_of_sines

from dln_jax.cli.arguments import arguments_of
from dln_jax.cli.commands import train_delan
from dln_jax.data.schema import from_arrays
from dln_jax.learning.gauges import summed_with_friction
from dln_jax.mechanics import lagrangian
from dln_jax.models.rigid_tree import USUAL
from dln_jax.scenes.datasets.generators import characters
from dln_jax.training.dynamics.run import prepare
from dln_jax.types import Needs

BRIEF = "--no-figures --no-low-latency --no-uncertainty"
PARTS = ("torque_mse", "inertial_mse", "coriolis_mse", "gravity_mse")
LETTERS = "letters.npz"
MASS, WEIGHT, SPRING, DAMPING, DRY = 2.0, 19.6, 30.0, 4.0, 3.0


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A folder with the embedded letters, as a file that states no needs."""
    folder, data = tmp_path_factory.mktemp("decompositions"), characters(dt=0.1)
    keys = ("t", "q", "qd", "qdd", "tau", "trajectory", "label", "tau_inertial", "tau_coriolis", "tau_gravity")
    np.savez(folder / LETTERS, **{key: getattr(data, key) for key in keys})
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield folder


def metrics_of(folder):
    return json_of(folder / "metrics.json")


def slide(drift):
    """Motions of a vertical slide on a spring with viscous and dry friction, and their torques with the true parts."""
    random, T = np.random.default_rng(1), 60
    t, trajectory = np.tile(0.05 * np.arange(T), 8), np.repeat(np.arange(8), T)
    sines = random.uniform([0.1, 1, 0], [0.3, 3, 6], (8, 3, 3)).transpose(2, 0, 1)[:, trajectory, None]
    x, v, acceleration = (wave[:, 0] for wave in sums_of_sines(t, *sines))
    x, v = x + drift * t, v + drift
    parts = {"tau_inertial": MASS * acceleration, "tau_coriolis": 0 * x, "tau_gravity": WEIGHT + SPRING * x}
    tau = sum(parts.values()) + DAMPING * v + DRY * np.tanh(v / 0.01)
    columns = {"q": x, "qd": v, "qdd": acceleration, "tau": tau, **parts}
    return {"t": t, "trajectory": trajectory, **{key: values[:, None] for key, values in columns.items()}}


def slid(workplace, drift):
    """Metrics of the default model of a slide."""
    np.savez(f"slide{drift}.npz", **slide(drift))
    needs = '{"joints": ["prismatic"], "friction": true}'
    command(train_delan, "--data", f"slide{drift}.npz", "--needs", needs, BRIEF, "--out", f"slide{drift}")
    return metrics_of(workplace / f"slide{drift}")


def test_weight_of_a_slide_is_its_gravity_and_no_offset_of_friction(workplace, capsys):
    metrics = slid(workplace, 0.0)
    assert max(metrics[part] for part in PARTS) < 1e-18 and metrics["gravity_determined"] == 1
    assert "friction kept by validation: viscous, coulomb\n" in capsys.readouterr().out


def test_dry_friction_of_a_slide_that_moves_one_way_is_known_only_with_its_weight(workplace, capsys):
    metrics = slid(workplace, 3.0)
    assert metrics["torque_mse"] < 1e-16 and metrics["gravity_determined"] == 0
    assert "gravity and friction of joints [1] are known only in sum" in capsys.readouterr().out


@pytest.mark.parametrize("model", ["structured-delan", "black-box-delan"])
def test_friction_beside_the_potential_of_a_network_has_no_offset(workplace, model):
    task = prepare(arguments_of(train_delan.Arguments, model=model, data=Path(LETTERS)))
    assert task.needs.joint_friction == ("viscous", "coulomb") and task.summed == []
    assert tuple(task.description["needs"]["joint_friction"]) == ("viscous", "coulomb")
    needs = json.dumps({"joints": ["revolute"] * 2, "gravity": False, "joint_friction": USUAL})
    weightless = prepare(arguments_of(train_delan.Arguments, model=model, data=Path(LETTERS), needs=needs))
    assert weightless.needs.joint_friction == USUAL


def test_joints_whose_potential_takes_a_constant():
    """Angles of joint 1 go all round the circle, those of joint 2 and the slide do not."""
    t = np.linspace(0, 1, 200)
    q = np.stack([7 * np.sin(9 * t), np.sin(9 * t), np.sin(9 * t)], axis=1)
    qd = np.stack([63 * np.cos(9 * t), 9 * np.cos(9 * t), 9 * np.cos(9 * t)], axis=1)
    data = from_arrays({"t": t, "q": q, "qd": qd, "qdd": -81 * q, "tau": q, "trajectory": 0 * t})
    needs = Needs(("revolute", "revolute", "prismatic"), joint_friction=USUAL)
    assert summed_with_friction(needs, data, network=True) == [2, 3]
    assert summed_with_friction(needs, data, network=False) == [3]
    assert summed_with_friction(needs._replace(gravity=False), data, network=True) == []
    dry, viscous = (needs._replace(joint_friction=(law,)) for law in ("coulomb", "viscous"))
    one_way = data._replace(qd=np.abs(qd))
    assert summed_with_friction(dry, data, network=True) == []
    assert summed_with_friction(dry, one_way, network=True) == [2, 3]
    assert summed_with_friction(viscous, one_way, network=True) == []
    # The rate of the second joint is the difference of two angles from the vertical.
    absolute = dry._replace(joint_map=((1.0, 0, 0), (-1, 1, 0), (0, 0, 1)))
    assert summed_with_friction(absolute, one_way._replace(qd=one_way.qd - [0, 0, 99]), network=True) == [2, 3]


def test_terms_of_a_lagrangian_linear_in_the_rates_take_no_power():
    """Viscous friction therefore cannot hide in the energy of a black-box model."""
    with jax.enable_x64(True):
        q, qd, qdd = jnp.asarray(np.random.default_rng(0).normal(size=(3, 3)))
        W = np.random.default_rng(1).normal(size=(3, 3))
        force = lagrangian.inverse_dynamics(lambda q, qd: jnp.sin(W @ q) @ (q * qd), q, qd, qdd)
        assert np.linalg.norm(force) > 0.1
        np.testing.assert_allclose(force @ qd, 0, atol=1e-14)


def test_letters_come_apart_by_default(workplace):
    command(train_delan, "--data", LETTERS, "--test e,q,v", BRIEF, "--out default")
    assert max(metrics_of(workplace / "default")[part] for part in PARTS) < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("model", ["auto", "structured-delan", "black-box-delan"])
@pytest.mark.parametrize("test", ["e,q,v", "a,d,h", "c,g,s"])
def test_letters_come_apart_for_every_model_and_split(workplace, model, test):
    """The published two-link arm, of which only the total torque is fitted."""
    out = f"{model}-{test[0]}"
    command(train_delan, "--data", LETTERS, "--test", test, "--model", model, "--seed 3", BRIEF, "--out", out)
    metrics = metrics_of(workplace / out)
    assert max(metrics[part] for part in PARTS) < 1e-8 and metrics["gravity_determined"] == 1
