"""Chains of links are identified from short motions about hanging, well enough to plan far from there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax.control.closed_loop import Hardware
from dln_jax.control.plants import Exploration, explore
from dln_jax.control.plants.mujoco_plants import mujoco_plant
from dln_jax.learning.recordings import FittedPlant, identified_chain, prepare
from dln_jax.learning.weak_forms import fit_momentum
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


def recorded(source, **settings):
    plant = mujoco_plant(source, hardware=Hardware(encoder_step=2 * np.pi / 4096, delay=1))
    recording = explore(plant, lambda _: pytest.fail("no model is needed"), BLIND).recording
    return prepare(recording, chain=True, **settings), plant.layout.needs


def mass_matrix(source, q):
    """That of MuJoCo."""
    model = mujoco.MjModel.from_xml_string(source)
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    M = np.zeros((len(q), len(q)))
    for column, unit in zip(M, np.eye(len(q)), strict=True):
        mujoco.mj_mulM(model, data, column, unit)
    return M


@pytest.mark.slow
def test_mass_matrix_is_right_everywhere_though_motions_stay_near_hanging():
    recording, needs = recorded(chain())
    found = identified_chain(recording, needs)
    assert found.description["name"] == "planar-chain" and found.description["directions"] == [1, 1, 1]
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (50, 3))
    truth = np.stack([mass_matrix(chain(), place) for place in q])
    M = jax.jit(jax.vmap(found.dynamics.mass_matrix))(q)
    np.testing.assert_allclose(M, truth, atol=0.1 * truth.max())


WEAK = """<mujoco><option timestep=".01" integrator="RK4"/><default><joint axis="0 1 0" damping=".05"/>
  <geom type="capsule" fromto="0 0 0 0 0 1" size=".05" mass="1" contype="0"/></default>
  <worldbody><body><joint/><geom/><body pos="0 0 1"><joint name="elbow"/><geom/></body></body></worldbody>
  <actuator><motor joint="elbow" ctrlrange="-2 2"/></actuator></mujoco>"""
"""An acrobot whose motor lifts a fifth of the weight of its link."""


def test_noise_does_not_shrink_the_inertias_of_a_plant_with_a_weak_motor():
    """An equation without a motor holds for zero parameters, too."""
    ready, needs = recorded(WEAK, delay=1)
    found = identified_chain(ready, needs)
    assert found.description["name"] == "planar-chain"
    truth = mass_matrix(WEAK, np.zeros(2))
    np.testing.assert_allclose(found.dynamics.mass_matrix(jnp.zeros(2)), truth, rtol=0.15)
    by_joints = FittedPlant(found.description, fit_momentum(build(found.description), ready.train).parameters)
    assert (by_joints.dynamics.mass_matrix(jnp.zeros(2)) < 0.8 * truth).all()
    # Torques of the wrong sign make every inertia negative.
    train, validation = (part._replace(tau=-part.tau) for part in (ready.train, ready.validation))
    with one_line(r"positive definite at 0\.0% of the recording's positions"):
        identified_chain(ready._replace(train=train, validation=validation), needs)
