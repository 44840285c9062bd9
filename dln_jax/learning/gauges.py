"""Finds forces of friction that the data cannot tell apart from those of a potential.

A potential whose slope may be any constant represents the offset of friction as well, and dry friction of a joint that
moves one way only: torques determine their sum. A polynomial of a prismatic displacement is such a potential. A network
of the cosine and sine of an angle becomes one if the recorded angles leave a gap in the circle.

Other friction is no such gauge. Over a closed path in the states (q, qd) it takes work, and forces of a Lagrangian take
none; terms linear in qd, A(q)ᵀ qd, only add the gyroscopic force (dA/dq - dA/dqᵀ) qd, whose power is zero.
"""

import numpy as np

from dln_jax.data.schema import Trajectories
from dln_jax.types import Needs

CIRCLE = 6.0
"""Range of angles that leaves no gap in the circle, rad: small networks do not bridge the last 0.28 rad."""


def summed_with_friction(needs: Needs, data: Trajectories, *, network: bool) -> list[int]:
    """Returns the joints, counted from 1, whose gravity and friction are known only in sum.

    Args:
        needs: the model's; gravity means a potential.
        data: the training data.
        network: whether the potential is a network; otherwise it is a polynomial, of cos q and sin q for angles.
    """
    laws = set(needs.joint_friction)
    rates = data.qd if needs.joint_map is None else data.qd @ np.transpose(needs.joint_map)
    one_way = np.ptp(np.sign(rates), axis=0) == 0
    constant = ("offset" in laws) | one_way & bool(laws - {"viscous", "load"})
    takes = (np.array(needs.joints) == "prismatic") | network & (np.ptp(data.q, axis=0) < CIRCLE)
    return (np.flatnonzero(needs.gravity & takes & constant) + 1).tolist()


def without_offset(needs: Needs) -> Needs:
    """Returns the needs without the offset of friction."""
    return needs._replace(joint_friction=tuple(law for law in needs.joint_friction if law != "offset"))
