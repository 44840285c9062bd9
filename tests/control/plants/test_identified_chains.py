"""A chain whose motor lifts a fifth of the weight is identified from short motions about hanging."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from calls import one_line

from dln_jax.control.closed_loop import Hardware
from dln_jax.control.plants.exploring import Exploration, explore
from dln_jax.control.plants.mujoco_plants import mujoco_plant
from dln_jax.learning.recordings import identified_chain, prepare

BLIND = Exploration(seconds=12.0, blind=(0.3, 0.4, 0.5, 0.6), surplus=())


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
    data = mujoco.MjData(model)
    truth = np.zeros((2, 2))
    mujoco.mj_forward(model, data)
    for column, unit in zip(truth, np.eye(2), strict=True):
        mujoco.mj_mulM(model, data, column, unit)
    np.testing.assert_allclose(found.dynamics.mass_matrix(jnp.zeros(2)), truth, rtol=0.15)
    # Torques of the wrong sign make every inertia negative.
    train, validation = (part._replace(tau=-part.tau) for part in (ready.train, ready.validation))
    with one_line(r"positive definite at only 0\.0% of the recorded positions"):
        identified_chain(ready._replace(train=train, validation=validation), plant.layout.needs)
