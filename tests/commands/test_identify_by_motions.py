"""identify --by motions and both: forces that no log records spoil torques of filtered motions, but hardly motions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import command, json_of, one_line

from dln_jax import dynamics, joint_dissipation, read_robot, tree_system
from dln_jax.commands import identify
from dln_jax.data.schema import from_arrays
from dln_jax.identification.equations import columns_of, flat
from dln_jax.identification.motions import cut_motions, fit_motions, linearise
from dln_jax.learning.linear import parameters_of
from dln_jax.learning.shooting import motion
from dln_jax.models.trees import make_rigid_tree

URDF = """<robot name="pendulum"><link name="base"/><link name="rod"><inertial><origin xyz="0 0 -0.2"/><mass value="1"/>
<inertia ixx="0.02" iyy="0.02" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hinge" type="continuous"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/></joint></robot>"""
STEP = 0.01


@pytest.fixture(scope="module")
def place(folder):
    """A pendulum with twice the stated mass, viscous friction and armature, driven by noisy torques; log of q alone."""
    (folder / "rod.urdf").write_text(URDF)
    tree = read_robot(folder / "rod.urdf").tree
    true = tree._replace(inertias=2 * tree.inertias, armature=np.array([0.02]))
    random = np.random.default_rng(0)
    t, tau, states = moved(tree_system(true, joint_dissipation([0.1], [0.0])), 20, substeps=4)
    q = states[:, :1] + 2e-4 * random.normal(size=tau.shape)
    np.savez("log.npz", t=t, q=q, tau=tau + 0.05 * random.normal(size=tau.shape), joint_names=["hinge"])
    return folder


def moved(system, seconds, **options):
    """Times, torques and states (q, qd) of a driven motion from rest."""
    t = np.arange(0, seconds, STEP)
    tau = (3 * np.sin(2 * t) + 2 * np.sin(5.1 * t + 1) + 1.5 * np.sin(0.7 * t))[:, None]
    with jax.enable_x64(True):
        states = jax.jit(lambda: motion(dynamics(system), jnp.zeros(2), jnp.asarray(t), jnp.asarray(tau), **options))()
    return t, tau, np.asarray(states)


def test_the_slope_of_windows_is_that_of_finite_differences(place):
    """Where all samples are noise-free, residuals vanish, so that Kaufman's derivative is exact."""
    model = make_rigid_tree(read_robot("rod.urdf").tree, friction=("viscous",))
    known = model.init(jax.random.key(0))
    theta = flat(known)
    theta[-1] = 0.1
    with jax.enable_x64(True):
        t, tau, states = moved(model.energies(parameters_of(theta, known)), 2)
    arrays = {"t": t, "q": states[:, :1], "qd": states[:, 1:], "tau": tau, "trajectory": np.zeros(len(t), int)}
    windows = cut_motions(from_arrays(arrays), 21)
    assert len(windows[1]) == 10
    at, scales = linearise(model), (np.array([1e-3]), np.array([0.1]))
    left, slopes = at(np.append(theta, 0.0), *scales, *windows)
    assert np.abs(left).max() < 1e-6
    for column in (0, 4, 10, 11):  # mass (no effect on a joint through the origin), I_xx, armature, friction
        change = 1e-5 * np.eye(len(theta))[column]
        above, below = (at(np.append(theta + sign * change, 0.0), *scales, *windows)[0] for sign in (1, -1))
        difference = (above - below) / 2e-5
        np.testing.assert_allclose(slopes[:, :, column], difference, atol=1e-4 * max(1.0, np.abs(difference).max()))
    stiff = np.concatenate([theta[:-1], [100.0]])
    # It decays at 100 / 0.06 1/s, and a Runge-Kutta step of 10 ms is stable up to 278.5 1/s.
    with one_line(r"friction is up to 5\.98 times too fast for the log's time step of 0\.01 s"):
        fit_motions(model, columns_of(known), stiff, stiff, *windows, noise_tau=scales[1])


def test_motions_identify_the_pendulum_and_predict_longer(place, capsys):
    log = "--robot rod.urdf --data log.npz --cutoff 4 --friction viscous --test last:25% --no-figures --no-uncertainty"
    numbers = {}
    for by, options in (("motions", "--out motions"), ("both", "--window 0.3 --out both")):
        command(identify, log, options, "--by", by)
        said = capsys.readouterr().out
        assert ("chosen by cross-validation in the training data: windows of" in said) == (by == "motions")
        assert f"fit to {by}: rms residual" in said and "verdict: good" in said
        numbers[by] = json_of(place / by / "metrics.json")
        assert numbers[by]["vpt_seconds"] >= numbers[by]["by_torques_vpt_seconds"]
        parameters = json_of(place / by / "parameters.json")["parameters"]
        value = {row["name"]: row["identified"] for row in parameters}
        assert value["viscous_1"] == pytest.approx(0.1, abs=0.01)
        assert value["I_yy_1"] + value["armature_1"] == pytest.approx(2 * (0.02 + 0.04) + 0.02, rel=0.02)
    assert abs(numbers["motions"]["delay_seconds"]) < 2e-3
