"""Decides whether a loop may be closed through a model, from motions that it was not fitted to.

A box around the training data is no such test: inside it, a network trained on too little data is as wrong as outside.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.control.tracking import definite
from dln_jax.data.schema import Trajectories
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.types import require_positive

MOST = 0.1
"""Largest nMSE of a joint's torques: the share of their variance that the model may leave unexplained."""


class Judgement(NamedTuple):
    """Verdict on a model."""

    usable: bool
    line: str
    """The reason, in a sentence."""
    nmse: Float[np.ndarray, " d"]
    """Mean squared errors of the joints' torques over their variances."""
    definite: float
    """Share of the states in which the mass matrix is positive definite."""


def judged(plant: Dynamics, held_out: Trajectories, *, most: float = MOST) -> Judgement:
    """Decides whether a model explains held-out torques, with a positive definite mass matrix in all states.

    Args:
        plant: the model.
        held_out: motions like those to follow, not used in the fit; joints with constant torques do not count.
        most: largest nMSE of the worst joint.
    """
    require_positive(most=most)
    q, qd, qdd = (jnp.asarray(each) for each in (held_out.q, held_out.qd, held_out.qdd))
    tau = np.asarray(jax.jit(jax.vmap(plant.inverse_dynamics))(q, qd, qdd))
    share = float(np.mean(np.asarray(jax.jit(jax.vmap(lambda q: definite(plant, q)))(q))))
    variance = np.var(held_out.tau, axis=0)
    moved = variance > 0
    nmse = np.mean((tau - held_out.tau) ** 2, axis=0) / np.where(moved, variance, np.nan)
    # An error that is not finite is the worst.
    worst = int(np.argmax(np.where(moved, np.where(np.isfinite(nmse), nmse, np.inf), -1.0)))
    usable = bool(nmse[worst] <= most) and share == 1.0
    if share < 1:
        line = f"the mass matrix is not positive definite in {1 - share:.1%} of the held-out states"
    else:
        line = f"of joint {worst + 1}'s held-out torques {nmse[worst]:.2%} are unexplained, and {most:.0%} may be"
    return Judgement(usable, f"{line}: the model is {'used' if usable else 'not asked at the state'}", nmse, share)
