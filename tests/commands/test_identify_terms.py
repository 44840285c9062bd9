"""identify with coupled motors, friction by load and by temperature, from MJCF to the model, its file and its C."""

import jax
import numpy as np
import pytest
from calls import assert_refused, command, json_of
from motions import sums_of_sines
from numpy.testing import assert_allclose
from small_logs import small_log

from dln_jax import dynamics, load, load_c, read_robot
from dln_jax.commands import identify
from dln_jax.export.c.source import export_c
from dln_jax.export.functions import functions_of_run
from dln_jax.models.trees import make_rigid_tree

MJCF = """<mujoco><worldbody>
<body name="upper" pos="0.1 0 0.2"><joint name="shoulder" axis="0 0.6 0.8" armature="0.1"/>
<inertial pos="0.1 0.05 0.2" mass="2" diaginertia="0.03 0.04 0.02"/>
<body name="lower" pos="0.1 0 0.2"><joint name="elbow" axis="0 1 0" armature="0.1"/>
<inertial pos="0.1 0.05 0.2" mass="2" diaginertia="0.03 0.04 0.02"/></body></body></worldbody></mujoco>"""
TERMS = {"motors": ((1.0, 0.0), (1.0, 1.0)), "cooling": (0.02, 0.01), "load": (0.15, 0.25)}


@pytest.fixture(scope="module")
def place(folder):
    (folder / "arm.xml").write_text(MJCF)
    tree = read_robot(folder / "arm.xml").tree
    heavier = tree._replace(inertias=1.2 * tree.inertias)
    model = make_rigid_tree(heavier, friction=("viscous", "coulomb", "load"), velocity_scale=0.05, **TERMS)
    known = {"armature": [0.15, 0.3], "viscous": [0.5, 0.4], "coulomb": [0.4, 0.3]}
    parameters = model.init(jax.random.key(0))._replace(**{key: np.array(value) for key, value in known.items()})
    random, t = np.random.default_rng(3), np.arange(0, 30, 0.02)
    states = sums_of_sines(t, *random.uniform([0.2, 0.5, 0], [0.6, 4, 6], (2, 5, 3)).transpose(2, 0, 1))
    temperature = 20 + 25 * (1 - np.exp(-t / 12))

    @jax.jit
    @jax.vmap
    def torque(q, qd, qdd, temperature):
        return dynamics(model.energies(parameters, temperature)).inverse_dynamics(q, qd, qdd)

    tau = np.asarray(torque(*states, temperature)) + 0.02 * random.normal(size=(len(t), 2))
    log = {"t": t, **dict(zip(("q", "qd", "qdd"), states, strict=True)), "tau": tau}
    np.savez("log.npz", temperature=temperature, **log)
    return folder


def test_all_terms_are_identified_and_written(place, capsys):
    terms = "--friction viscous,coulomb,load,temperature --motors 1,0;1,1"
    command(identify, "--robot arm.xml --data log.npz --out run --no-figures", terms)
    said = capsys.readouterr().out
    assert "friction by load: kept" in said and "friction by temperature: kept" in said and "verdict: good" in said
    metrics = json_of(place / "run/metrics.json")
    assert metrics["nmse"] < 2 * metrics["noise_nmse"]
    state = np.random.default_rng(1).normal(size=(3, 2))
    with jax.enable_x64(True):
        run = load("run")
        assert_allclose(run.description["load"], TERMS["load"], atol=0.04)
        assert_allclose(run.description["cooling"], TERMS["cooling"], atol=3e-3)
        assert_allclose(run.parameters.coulomb, [0.4, 0.3], atol=0.05)
        # Hot grease: the same functions in C at a stated temperature.
        export_c(functions_of_run(run, names=["inverse_dynamics"], temperature=60.0), "c")
        hot = dynamics(run.model.energies(run.parameters, 60.0)).inverse_dynamics(*state)
        assert_allclose(load_c("c").inverse_dynamics(*state), hot, rtol=1e-10)
        assert np.abs(hot - run.dynamics.inverse_dynamics(*state)).max() > 0.05
    # The file has the coupled motor.
    S = np.array(TERMS["motors"])
    armature = S.T @ np.diag(run.parameters.armature) @ S
    assert_allclose(read_robot("run/arm_identified.xml").tree.armature, armature)


def test_terms_that_are_none_are_refused(folder, capsys):
    (folder / "arm.xml").write_text(MJCF)
    np.savez("cold.npz", **small_log(2))
    rows = [
        ("--motors 1,0", "--motors has 1 rows; expected 2"),
        ("--motors 1,1;1,1", "expected an invertible matrix"),
        ("--coupled 1-2", "--coupled has '1-2'; expected pairs of joints such as 2:3"),
        ("--coupled 1:3", "--coupled is 1:3; expected distinct pairs i:j of joints"),
        ("--friction coulomb,temperature", "temperature changes viscous friction"),
        ("--friction viscous,temperature", "friction by temperature needs temperatures, but the data have none"),
    ]
    assert_refused(capsys, identify, rows, "--robot arm.xml --data cold.npz --accept-log", out=folder / "none")
