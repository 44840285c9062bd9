"""Finds motors that turn with two joints, such as those of coupled wrists, in torques that a fit leaves unexplained.

A motor with the rate m = qd_j + c qd_i, i < j, has friction F(m), which acts on both joints:

    left_j = F_j(qd_j) + F(m),    left_i = F_i(qd_i) + c F(m),    F(v) = b v + k tanh(v / s)

Its share is what F(m) explains beyond friction of the joints' own rates, in that joint of the two where it is less.
"""

import numpy as np
from jaxtyping import Float

RATIOS = (-2.0, -1.5, -1.0, -0.75, -0.5, -0.25, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0)
"""Values of c that are tried."""
SHARE = 0.3
"""Smallest share of the unexplained variance in both joints."""
SMOOTH = 0.1
"""s, as a share of the root mean square rate."""
MOST = 4000
"""Number of samples that is enough."""


def shared_motor(left: Float[np.ndarray, "N d"], qd: Float[np.ndarray, "N d"]) -> tuple[int, int, float, float] | None:
    """Returns j, i (from 0), c and the share of the motor that explains most; `None` if none explains enough."""
    d = left.shape[1]
    scale = left.std(axis=0)
    moving = np.flatnonzero((scale > 0) & (qd.std(axis=0) > 0))
    own = {k: np.column_stack([_friction(qd[:, k]), np.ones(len(qd))]) for k in moving}
    best = None
    for j in moving:
        for i in moving[moving < j]:
            before = [_unexplained(own[k], left[:, k] / scale[k]) for k in (j, i)]
            for c in RATIOS:
                of_motor, zero = _friction(qd[:, j] + c * qd[:, i]), np.zeros_like(own[i])
                A = np.block([
                    [own[j] / scale[j], zero, of_motor / scale[j]],
                    [zero, own[i] / scale[i], c * of_motor / scale[i]],
                ])  # fmt: skip
                y = np.concatenate([left[:, k] / scale[k] for k in (j, i)])
                rest = (y - A @ np.linalg.lstsq(A, y, rcond=None)[0]).reshape(2, -1)
                share = float(np.min(1 - np.mean(rest**2, axis=1) / before))
                if share >= SHARE and (best is None or share > best[3]):
                    best = int(j), int(i), c, share
    return best if d > 1 else None


def _friction(rate: np.ndarray) -> np.ndarray:
    return np.column_stack([rate, np.tanh(rate / (SMOOTH * np.sqrt(np.mean(rate**2)) + 1e-300))])


def _unexplained(A: np.ndarray, y: np.ndarray) -> float:
    return float(np.mean((y - A @ np.linalg.lstsq(A, y, rcond=None)[0]) ** 2)) + 1e-300
