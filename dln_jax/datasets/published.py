"""The published test motions of the two-link arm (Lutter et al. 2019, the `uniform` experiment).

Three free swings from rest, 400 samples at 0.02 s, integrated by symplectic Euler at 2 ms. That integrator is part of
the data: it is of order 1, so that an accurate rollout of the true plant leaves these motions after some seconds
(valid prediction time 6.47 s). Angle zero is horizontal, as in the letters: the published results hold these motions,
and the arm so turned repeats them to 8e-5 rad.
"""

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.data.schema import Trajectories
from dln_jax.datasets.generators import completed
from dln_jax.mechanics.integrators import rollout, symplectic_euler
from dln_jax.precision import in_float64
from dln_jax.scenes.scene import closed_form_forward_dynamics
from dln_jax.scenes.two_link_arm import two_link_arm

SAMPLES = 400
SAMPLE_SPACING = 0.02
"""s"""
SUBSTEPS = 10
"""Steps of symplectic Euler per sample."""
STARTS = np.array([[np.pi / 4, np.pi / 4], [-np.pi, -np.pi / 2], [-np.pi / 4, np.pi / 2]])
"""Postures at rest, q2 relative to link 1 and zero horizontal, rad."""


@in_float64
def uniform_tests() -> Trajectories:
    """The three test motions, with zero torque; accelerations are those of the plant at the stored states."""
    scene = two_link_arm()
    rest = np.zeros_like(STARTS)

    def acceleration(q, qd):
        return closed_form_forward_dynamics(scene, q, qd, jnp.zeros_like(q))

    step = symplectic_euler(velocity=lambda t, q, qd: qd, force=lambda t, q, qd: acceleration(q, qd))
    t = SAMPLE_SPACING * np.arange(SAMPLES)

    @jax.jit
    @jax.vmap
    def swing(q, qd):
        return rollout(step, (q, qd), jnp.asarray(t), substeps=SUBSTEPS)

    q, qd = (np.asarray(states).reshape(-1, 2) for states in swing(STARTS, rest))
    qdd = np.asarray(jax.jit(jax.vmap(acceleration))(q, qd))
    trajectory = np.repeat(np.arange(len(STARTS)), SAMPLES)
    label = np.array([f"swing-{index}" for index in range(len(STARTS))])
    data = completed(scene, np.tile(t, len(STARTS)), q, qd, qdd, trajectory, label)
    return data._replace(tau=np.zeros_like(q))
