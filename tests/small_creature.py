"""The smallest creature: a block of two cells that two muscles along its sides bend, and short episodes."""

import numpy as np

from dln_jax.locomotion.task import make_task
from dln_jax.softbody.mesh.mesh import make_mesh
from dln_jax.softbody.mesh.shapes import Creature, lattice

EPISODE = 12


def block_task():
    """Its task."""
    positions, triangles = lattice([(0, 0), (1, 0)])
    mesh = make_mesh(0.4 * np.asarray(positions, float), triangles)
    number = {tuple(place): index for index, place in enumerate(np.asarray(positions).tolist())}
    muscles = np.array([[number[0, 0], number[0, 1]], [number[0, 1], number[1, 1]]])
    return make_task(Creature("block", mesh, muscles), episode=EPISODE, clock_period=6.0, upright=0.04)
