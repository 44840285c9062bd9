"""Friction laws of joints through the command line: what is stated is trained, by every optimiser, and loads again."""

import json

import jax
import numpy as np
import pytest
from calls import command, refused

from dln_jax.cli.commands import train_delan, train_hnn
from dln_jax.data import schema
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.mechanics.joint_friction import with_friction
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.pendulums import pendulum
from dln_jax.zoo.run import load

QUICK = "--data swing.npz --no-figures --no-low-latency"
NEEDS = {"joints": ["revolute"], "joint_friction": ["viscous", "coulomb"], "velocity_scale": 0.05}


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A folder with a pendulum whose joint has viscous and dry friction."""
    folder = tmp_path_factory.mktemp("friction")
    scene = pendulum()
    plant = with_friction(scene.closed_form, joint_dissipation([0.2], [0.4], velocity_scale=0.05))
    data = generators.uniform(scene, samples=120, rate_bound=1.0, acceleration_bound=5.0)
    tau = np.asarray(jax.jit(jax.vmap(dynamics(plant).inverse_dynamics))(data.q, data.qd, data.qdd))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        schema.save("swing.npz", data._replace(tau=tau))
        yield folder


def test_the_trigonometric_model_finds_friction_by_its_linear_fit(workplace, capsys):
    command(train_delan, QUICK, "--needs", json.dumps(NEEDS), "--model trigonometric --out linear")
    run = load(workplace / "linear")
    assert run.description["needs"]["joint_friction"] == ["viscous", "coulomb"]
    coefficients = run.parameters["friction"].coefficients
    np.testing.assert_allclose([*coefficients["viscous"], *coefficients["coulomb"]], [0.2, 0.4], atol=1e-9)
    needs = json.dumps({**NEEDS, "joint_friction": ["viscous", "rust"]})
    line = refused(capsys, train_delan, QUICK, "--needs", needs)
    assert "joint_friction has 'rust'; expected some of viscous, coulomb, stribeck" in line


@pytest.mark.slow
def test_every_kind_trains_with_friction(workplace):
    needs = json.dumps({**NEEDS, "joint_friction": ["viscous", "coulomb", "stribeck", "load"]})
    for script, options in (
        (train_delan, "--model structured-delan --optimizer adam"),
        (train_hnn, "--model structured-hnn --optimizer gauss-newton --no-uncertainty"),
    ):
        out = workplace / script.__name__
        command(script, QUICK, "--width 3 --depth 1 --steps 6", options, "--needs", needs, "--out", out)
        run = load(out)
        assert set(run.parameters["friction"].shape) == {"stribeck_velocity", "load"}
        moved = [np.abs(leaf + 3.0).max() for leaf in run.parameters["friction"].coefficients.values()]
        assert min(moved) > 0 and np.isfinite(run.dynamics.inverse_dynamics([0.3], [0.1], [1.0])).all()
