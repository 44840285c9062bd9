"""The published test motions of the two-link arm (Lutter et al. 2019, the `uniform` experiment)."""

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.data.schema import Trajectories
from dln_jax.mechanics.integrators import rollout, symplectic_euler
from dln_jax.precision import in_float64
from dln_jax.scenes.datasets.generators import swings
from dln_jax.scenes.pendulums import two_link_arm
from dln_jax.scenes.scene import closed_form_forward_dynamics

STARTS = np.array([[np.pi / 4, np.pi / 4], [-np.pi, -np.pi / 2], [-np.pi / 4, np.pi / 2]])
"""Postures at rest of the published test, rad: q2 is relative to link 1, zero is horizontal."""


@in_float64
def uniform_tests() -> Trajectories:
    """The published test motions of the two-link arm (Lutter et al. 2019, the `uniform` experiment), from `STARTS`.

    Three free swings from rest, 400 samples at 0.02 s, integrated by symplectic Euler at 2 ms. The integrator is part
    of the data: it is of order 1, so an accurate rollout of the true plant departs from these motions after some
    seconds (valid prediction time 6.47 s). Angle zero is horizontal, as in the letters: the published results contain
    these motions, and this arm reproduces them to 8e-5 rad. Accelerations are those of the plant at the stored states.
    """
    scene, t = two_link_arm(), 0.02 * np.arange(400)
    step = symplectic_euler(
        velocity=lambda t, q, qd: qd,
        force=lambda t, q, qd: closed_form_forward_dynamics(scene, q, qd, jnp.zeros_like(q)),
    )
    motion = jax.jit(jax.vmap(lambda q, qd: rollout(step, (q, qd), jnp.asarray(t), substeps=10)))
    return swings(scene, t, *map(np.asarray, motion(STARTS, np.zeros_like(STARTS))))
