"""Chains of links are identified from short motions about hanging, well enough to plan far from there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control.closed_loop import Hardware
from dln_jax.control.plants import Exploration, explore
from dln_jax.control.plants.mujoco_plants import mujoco_plant
from dln_jax.learning.recordings import FittedPlant, identified_chain, prepare
from dln_jax.learning.weak_forms import fit_momentum
from dln_jax.types import InputError
from dln_jax.zoo.descriptions import build

mujoco = pytest.importorskip("mujoco", reason="MuJoCo simulates the plant; it is in the extra [robot]")
LENGTHS, MASSES = (0.2, 0.22, 0.25), (0.5, 0.4, 0.3)
BLIND = Exploration(seconds=12.0, blind=(0.3, 0.4, 0.5, 0.6), surplus=())


def chain() -> str:
    """A chain of three rods whose first joint is passive."""
    text, above = "", 0.0
    for number, (length, mass) in enumerate(zip(LENGTHS, MASSES, strict=True)):
        text += f'<body pos="0 0 {-above}"><joint name="j{number}" axis="0 1 0" damping="0.005"/>'
        text += f'<geom type="capsule" fromto="0 0 0 0 0 {-length}" size=".01" mass="{mass}" contype="0"/>'
        above = length
    motors = '<motor joint="j1" ctrlrange="-6 6"/><motor joint="j2" ctrlrange="-4 4"/>'
    bodies = f"<worldbody>{text}{'</body>' * 3}</worldbody>"
    return f'<mujoco><option timestep=".002" integrator="RK4"/>{bodies}<actuator>{motors}</actuator></mujoco>'


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    file = tmp_path_factory.mktemp("chain") / "chain.xml"
    file.write_text(chain())
    plant = mujoco_plant(file, hardware=Hardware(encoder_step=2 * np.pi / 4096, delay=1))
    recording = explore(plant, lambda _: pytest.fail("no model is needed"), BLIND).recording
    return prepare(recording, chain=True), plant.layout.needs


def test_the_mass_matrix_is_right_all_over_though_motions_stay_near_hanging(prepared):
    recording, needs = prepared
    found = identified_chain(recording, needs)
    assert found.description["name"] == "planar-chain" and found.description["directions"] == [1, 1, 1]
    model = mujoco.MjModel.from_xml_string(chain())
    data = mujoco.MjData(model)
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (50, 3))
    truth = np.zeros((50, 3, 3))
    for place, M in zip(q, truth, strict=True):
        data.qpos[:] = place
        mujoco.mj_forward(model, data)
        for column, unit in zip(M, np.eye(3), strict=True):
            mujoco.mj_mulM(model, data, column, unit)
    M = jax.vmap(found.dynamics.mass_matrix)(jnp.asarray(q))
    np.testing.assert_allclose(M, truth, atol=0.1 * truth.max())


WEAK = """<mujoco><option timestep=".01" integrator="RK4"/><default><joint axis="0 1 0" damping=".05"/>
  <geom type="capsule" fromto="0 0 0 0 0 1" size=".05" mass="1" contype="0"/></default>
  <worldbody><body><joint/><geom/><body pos="0 0 1"><joint name="elbow"/><geom/></body></body></worldbody>
  <actuator><motor joint="elbow" ctrlrange="-2 2"/></actuator></mujoco>"""
"""An acrobot whose motor lifts a fifth of the weight of its link."""


def test_noise_does_not_shrink_the_inertias_of_a_plant_with_a_weak_motor():
    """An equation without a motor holds for zero parameters, too."""
    plant = mujoco_plant(WEAK, hardware=Hardware(encoder_step=2 * np.pi / 4096, delay=1))
    recording = explore(plant, lambda _: pytest.fail("no model is needed"), BLIND).recording
    ready = prepare(recording, delay=1, chain=True)
    found = identified_chain(ready, plant.layout.needs)
    assert found.description["name"] == "planar-chain"
    model = mujoco.MjModel.from_xml_string(WEAK)
    data, truth = mujoco.MjData(model), np.zeros((2, 2))
    mujoco.mj_forward(model, data)
    for column, unit in zip(truth, np.eye(2), strict=True):
        mujoco.mj_mulM(model, data, column, unit)
    np.testing.assert_allclose(found.dynamics.mass_matrix(jnp.zeros(2)), truth, rtol=0.15)
    by_joints = FittedPlant(found.description, fit_momentum(build(found.description), ready.train).parameters)
    assert (by_joints.dynamics.mass_matrix(jnp.zeros(2)) < 0.8 * truth).all()


def test_a_recording_that_says_too_little_is_refused_with_a_share(prepared):
    recording, needs = prepared
    # Torques of the wrong sign make every inertia negative.
    backward = recording._replace(
        train=recording.train._replace(tau=-recording.train.tau),
        validation=recording.validation._replace(tau=-recording.validation.tau),
    )
    with pytest.raises(InputError, match=r"positive definite at 0\.0% of the recording's positions"):
        identified_chain(backward, needs)
