"""Motions that tests compare with."""

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.mechanics.equations import flow
from dln_jax.mechanics.hamiltonian import HamiltonianSystem
from dln_jax.mechanics.integrators import rk4, rollout


def quick_motion(H, q, p, t, *, dissipation=None, tolerance=None):
    """In place of `reference_motion`, which takes seconds to compile: RK4 with fixed steps."""
    step = rk4(lambda t, state: flow(HamiltonianSystem(H, dissipation)).rates(*state))
    motion = jax.jit(jax.vmap(lambda q, p: rollout(step, (q, p), jnp.asarray(t), substeps=10)))
    return tuple(np.asarray(state) for state in motion(q, p))


def sums_of_sines(t, sizes, rates, phases):
    """Coordinates, rates and accelerations [T, d] of sums of sines, whose numbers are [d, n] or [T, d, n]."""
    angles = rates * np.asarray(t)[:, None, None] + phases
    waves = sizes * np.sin(angles), sizes * rates * np.cos(angles), -sizes * rates**2 * np.sin(angles)
    return tuple(wave.sum(axis=2) for wave in waves)
