"""A planar arm, whose base parameters are known in closed form, and data of it."""

import jax
import numpy as np
from motions import sums_of_sines

from dln_jax import joint_dissipation, tree_system
from dln_jax.data.schema import from_arrays
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees.description import serial
from dln_jax.mechanics.trees.inertia import inertial_parameters

LENGTH = 0.5
LINKS = [
    inertial_parameters(2.0, [0.2, 0.05, 0.1], np.diag([0.02, 0.04, 0.05])),
    inertial_parameters(1.0, [0.3, -0.02, 0.03], np.diag([0.01, 0.02, 0.015])),
]
ARM = serial(
    np.stack([np.eye(3)] * 2),
    [[0, 0, 0], [LENGTH, 0, 0]],
    LINKS,
    armature=[0.1, 0.2],
    gravity=(0, -9.81, 0),
    names=("shoulder", "elbow"),
)
URDF = """<robot name="arm"><link name="base"/>
<link name="upper"><inertial><origin xyz="0.1 0.05 0.2"/><mass value="2"/>
<inertia ixx="0.03" iyy="0.04" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="lower"><inertial><origin xyz="0.1 0.05 0.2"/><mass value="1"/>
<inertia ixx="0.03" iyy="0.04" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/>
<origin xyz="0.2 0 0.1" rpy="0.4 0 0"/><axis xyz="0 0 1"/><dynamics damping="0.2"/></joint>
<joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/>
<origin xyz="0.2 0 0.1" rpy="1.2 0 0"/><axis xyz="0 0 1"/><dynamics damping="0.2"/></joint></robot>"""
"""A robot's file of two joints in space."""
FRICTION = {"viscous": np.array([0.2, 0.1]), "coulomb": np.array([0.5, 0.3]), "offset": np.array([0.1, -0.2])}


def motions(seed, *, noise=0.0, trajectories=1, samples=120, friction=True, still=(), tree=ARM):
    """Sums of sines, exact rates, and torques with noise."""
    random, parts = np.random.default_rng(seed), []
    t = np.linspace(0, 6, samples)
    for index in range(trajectories):
        sizes, rates, phases = random.uniform([0.1, 0.5, 0], [0.8, 3, 6], (2, 4, 3)).transpose(2, 0, 1)
        sizes = sizes * ~np.isin(np.arange(2), still)[:, None]
        parts.append([t, *sums_of_sines(t, sizes, rates, phases), np.full(samples, index)])
    t, q, qd, qdd, trajectory = (np.concatenate(each) for each in zip(*parts, strict=True))
    system = tree_system(tree, joint_dissipation(*FRICTION.values()) if friction else None)
    tau = np.asarray(jax.jit(jax.vmap(dynamics(system).inverse_dynamics))(q, qd, qdd))
    tau = tau + noise * random.normal(size=tau.shape)
    return from_arrays({"t": t, "q": q, "qd": qd, "qdd": qdd, "tau": tau, "trajectory": trajectory})
