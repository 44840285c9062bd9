"""A plain regression of torques, which knows no robot: what any arm's torque is roughly made of.

    tau_i = sum over j of a_ij qdd_j + b_ij qd_j² + c_ij sin q_j + e_ij cos q_j
            + v_i qd_i + f_i tanh(qd_i / scale) + o_i

(q_j and q_j² in place of sine and cosine of a prismatic joint.) Its accuracy is modest, but signs, delays and dry
friction stand out of it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.data.checks.delays import away_from_ends, vertex
from dln_jax.data.schema import Trajectories

MOST = 4000
"""Samples that are fitted to."""
SCALE = 0.05
"""Of a joint's typical velocity, on which dry friction is smooth."""


class Surrogate(NamedTuple):
    """The regression of all joints."""

    rows: np.ndarray
    """Samples that were fitted to [n]."""
    explained: Float[np.ndarray, " d"]
    """Share of each torque's variance."""
    inertia: Float[np.ndarray, " d"]
    """a_ii, kg m² or kg."""
    inertia_seen: Float[np.ndarray, " d"]
    """By which factor the squared error grows without it, less one."""
    viscous: Float[np.ndarray, " d"]
    """N m s or N s/m."""
    coulomb: Float[np.ndarray, " d"]
    """N m or N."""
    velocity_scale: Float[np.ndarray, " d"]
    """1/s or m/s, on which dry friction is smooth."""
    friction_seen: Float[np.ndarray, " d"]
    """By which factor the squared error grows without both, less one."""
    rest: Float[np.ndarray, "n d"]
    """The torque that nothing but friction explains: friction and error."""
    delay: float
    """Samples by which torques are late."""
    delay_gain: float
    """Squared error at no delay over that at this one."""
    delays: Float[np.ndarray, " S"]
    """Samples that were tried."""
    delay_error: Float[np.ndarray, " S"]
    """Unexplained share of the variance at each, geometric mean over joints: those that are explained well decide."""


def common_columns(data: Trajectories, joints: Sequence[str]) -> np.ndarray:
    """What torques of all joints are made of [N, 4 d + 1]."""
    turning = np.array([kind == "revolute" for kind in joints])
    waves = [np.where(turning, np.sin(data.q), data.q), np.where(turning, np.cos(data.q), data.q**2)]
    return np.hstack([data.qdd, data.qd**2, *waves, np.ones((len(data.t), 1))])


def surrogate(data: Trajectories, joints: Sequence[str], *, farthest: int) -> Surrogate | None:
    """The regression, and the delay up to `farthest` samples at which it is best; `None` with too few samples."""
    d = data.degrees_of_freedom
    inside = away_from_ends(data.trajectory, farthest)
    shared = 4 * d + 1
    if len(inside) < 4 * (shared + 2):
        return None
    rows = inside[:: -(-len(inside) // MOST)]
    common = _scaled(common_columns(data, joints)[rows])
    speed = np.maximum(np.sqrt(np.mean(data.qd**2, axis=0)), np.finfo(float).tiny)
    dry = np.tanh(data.qd / (SCALE * speed))
    shifts = np.arange(-farthest, farthest + 1)
    out: dict[str, list] = {key: [] for key in ("explained", "a", "a_seen", "v", "f", "f_seen", "rest", "late")}
    for joint in range(d):
        own = np.column_stack([data.qd[rows, joint], dry[rows, joint]])
        basis = _basis(np.column_stack([common, own]))
        torque = data.tau[:, joint]
        tau = torque[rows]
        variance = max(float(np.sum((tau - tau.mean()) ** 2)), np.finfo(float).tiny)
        shifted = np.stack([torque[rows + shift] for shift in shifts], axis=1)
        centred = np.maximum(np.sum((shifted - shifted.mean(axis=0)) ** 2, axis=0), np.finfo(float).tiny)
        late = np.maximum(np.sum(shifted**2, axis=0) - np.sum((basis.T @ shifted) ** 2, axis=0), 0.0) / centred
        left = tau - basis @ (basis.T @ tau)
        error = max(float(left @ left), 1e-20 * variance, np.finfo(float).tiny)
        out["explained"].append(1 - error / variance)
        out["late"].append(late)
        without = _basis(common)
        friction = np.linalg.lstsq(own - without @ (without.T @ own), tau - without @ (without.T @ tau), rcond=1e-10)[0]
        bare = tau - without @ (without.T @ tau)
        out["v"].append(friction[0])
        out["f"].append(friction[1])
        out["f_seen"].append(float(bare @ bare) / error - 1)
        out["rest"].append(left + own @ friction)
        others = _basis(np.column_stack([np.delete(common, joint, axis=1), own]))
        column = data.qdd[rows, joint]
        column = column - others @ (others.T @ column)
        size = float(column @ column)
        a = float(column @ tau) / size if size > 1e-12 * float(np.sum(data.qdd[rows, joint] ** 2)) else 0.0
        out["a"].append(a)
        out["a_seen"].append(a**2 * size / error)
    error = np.exp(np.mean(np.log(np.clip(out["late"], 1e-12, 1.0)), axis=0))
    best = int(np.argmin(error))
    return Surrogate(
        rows, *(np.array(out[key]) for key in ("explained", "a", "a_seen", "v", "f")),
        velocity_scale=SCALE * speed, friction_seen=np.array(out["f_seen"]),
        rest=np.array(out["rest"]).T, delay=float(shifts[best]) + vertex(error, best),
        delay_gain=float(error[farthest] / max(error[best], 1e-20)), delays=shifts.astype(float), delay_error=error,
    )  # fmt: skip


def _scaled(columns: np.ndarray) -> np.ndarray:
    sizes = np.linalg.norm(columns, axis=0)
    return columns / np.where(sizes > 0, sizes, 1.0)


def _basis(columns: np.ndarray) -> np.ndarray:
    """An orthonormal basis of what columns span."""
    left, sizes, _ = np.linalg.svd(_scaled(columns), full_matrices=False)
    return left[:, sizes > 1e-8 * sizes[0]]
