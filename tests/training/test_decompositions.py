"""Parts of a torque: those that data determine are right by default, and a run says which are known only in sum."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import command, json_of
from motions import sums_of_sines

from dln_jax import Needs
from dln_jax.commands import train_delan
from dln_jax.data import schema
from dln_jax.data.log import read_log, split_log
from dln_jax.data.schema import from_arrays
from dln_jax.learning.dynamics import summed_with_friction
from dln_jax.learning.engine.checkpoint import Context
from dln_jax.learning.fits.network import plan_network
from dln_jax.learning.fits.settings import Network
from dln_jax.mechanics import lagrangian
from dln_jax.mechanics.friction import USUAL
from dln_jax.scenes.datasets.generators import characters

BRIEF = "--no-figures --no-uncertainty"
PARTS = ("torque_mse", "inertial_mse", "coriolis_mse", "gravity_mse")
LETTERS = "letters.npz"


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A folder with the embedded letters, as a file that states no needs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("decompositions"))
        schema.save(LETTERS, characters(dt=0.1)._replace(needs=None))
        yield Path.cwd()


def metrics_of(folder):
    return json_of(folder / "metrics.json")


def slid(workplace, drift):
    """Metrics of the default model of a vertical slide on a spring with viscous and dry friction."""
    random, t = np.random.default_rng(1), np.tile(0.05 * np.arange(60), 8)
    trajectory = np.repeat(np.arange(8), 60)
    sines = random.uniform([0.1, 1, 0], [0.3, 3, 6], (8, 3, 3)).transpose(2, 0, 1)[:, trajectory, None]
    x, v, acceleration = sums_of_sines(t, *sines)
    x, v = x + drift * t[:, None], v + drift
    parts = {"tau_inertial": 2.0 * acceleration, "tau_coriolis": 0 * x, "tau_gravity": 19.6 + 30.0 * x}
    tau = sum(parts.values()) + 4.0 * v + 3.0 * np.tanh(v / 0.01)
    np.savez(f"slide{drift}.npz", t=t, trajectory=trajectory, q=x, qd=v, qdd=acceleration, tau=tau, **parts)
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
    assert "gravity and friction of joints [1] are known only as a sum" in capsys.readouterr().out


def test_friction_beside_the_potential_of_a_network_has_no_offset(workplace):
    weightless = Needs(("revolute",) * 2, gravity=False, joint_friction=USUAL)
    for needs, laws in ((None, ("viscous", "coulomb")), (weightless, USUAL)):
        log = read_log(LETTERS, needs=needs)
        parts = split_log(log)
        plan = plan_network(Network(), log, parts, Context())
        assert (
            plan.needs.joint_friction == laws and summed_with_friction(plan.needs, parts.sets.train, network=True) == []
        )
        assert tuple(plan.description["needs"]["joint_friction"]) == laws


def test_joints_whose_potential_takes_a_constant():
    """Angles of joint 1 go all round the circle, those of joint 2 and the slide do not."""
    t = np.linspace(0, 1, 200)
    q = np.sin(9 * t)[:, None] * [7, 1, 1]
    qd = np.cos(9 * t)[:, None] * [63, 9, 9]
    data = from_arrays({"t": t, "q": q, "qd": qd, "qdd": -81 * q, "tau": q, "trajectory": 0 * t})
    one_way = data._replace(qd=np.abs(qd))
    needs = Needs(("revolute", "revolute", "prismatic"), joint_friction=USUAL)
    dry, viscous = (needs._replace(joint_friction=(law,)) for law in ("coulomb", "viscous"))
    # The rate of the second joint is the difference of two angles from the vertical.
    absolute = dry._replace(joint_map=((1.0, 0, 0), (-1, 1, 0), (0, 0, 1)))
    for stated, moved, network, expected in (
        (needs, data, True, [2, 3]),
        (needs, data, False, [3]),
        (needs._replace(gravity=False), data, True, []),
        (dry, one_way, True, [2, 3]),
        (viscous, one_way, True, []),
        (absolute, one_way._replace(qd=one_way.qd - [0, 0, 99]), True, [2, 3]),
    ):
        assert summed_with_friction(stated, moved, network=network) == expected


def test_terms_of_a_lagrangian_linear_in_the_rates_take_no_power():
    """Viscous friction therefore cannot hide in the energy of a black-box model."""
    with jax.enable_x64(True):
        q, qd, qdd = jnp.asarray(np.random.default_rng(0).normal(size=(3, 3)))
        W = np.random.default_rng(1).normal(size=(3, 3))
        force = lagrangian.inverse_dynamics(lambda q, qd: jnp.sin(W @ q) @ (q * qd), q, qd, qdd)
        assert np.linalg.norm(force) > 0.1
        np.testing.assert_allclose(force @ qd, 0, atol=1e-14)


@pytest.mark.parametrize("model", ["auto", "structured-delan", "black-box-delan"])
def test_letters_come_apart_for_every_model(workplace, model):
    """The published two-link arm, of which only the total torque is fitted."""
    command(train_delan, "--data", LETTERS, "--test e,q,v --seed 3 --model", model, BRIEF, "--out", model)
    metrics = metrics_of(workplace / model)
    assert max(metrics[part] for part in PARTS) < 1e-8 and metrics["gravity_determined"] == 1
