"""The simulated Franka Panda for comparing models that do not know its kinematics.

Giacomuzzo, Carli, Romeres and Dalla Libera, T-RO 2024 (arXiv 2310.06585): masses and centres after Gaz et al. (RA-L
2019). That paper's moments are taken about the links' frames, so some links are not physically consistent, which does
not matter for a comparison.
"""

import numpy as np

from dln_jax.mechanics.trees.description import dh_frames, serial, with_payload
from dln_jax.scenes.robot_arms import Arm
from dln_jax.types import InputError

_RIGHT = np.pi / 2
_ROWS = [  # alpha, a, d, theta
    [0, 0, 0.333, 0], [-_RIGHT, 0, 0, 0], [_RIGHT, 0, 0.316, 0], [_RIGHT, 0.0825, 0, 0],
    [-_RIGHT, -0.0825, 0.384, 0], [_RIGHT, 0, 0, 0], [_RIGHT, 0.088, 0, 0],
]  # fmt: skip
_MASSES = [4.970684, 0.646926, 3.228604, 3.587895, 1.225946, 1.666555, 0.735522]
_CENTRES = [
    [3.875e-3, 2.081e-3, -0.175], [-3.141e-3, -2.872e-2, 3.495e-3], [2.7518e-2, 3.9252e-2, -6.6502e-2],
    [-5.317e-2, 1.04419e-1, 2.7454e-2], [-1.1953e-2, 4.1065e-2, -3.8437e-2], [6.0149e-2, -1.4117e-2, -1.0517e-2],
    [1.0517e-2, -4.252e-3, 6.1597e-2],
]  # fmt: skip
_MOMENTS = [
    [0.70337, -1.39e-4, 6.772e-3, 0.70661, 1.9169e-2, 9.117e-3],
    [7.962e-3, -3.925e-3, 1.0254e-2, 2.811e-2, 7.04e-4, 2.5995e-2],
    [3.7242e-2, -4.761e-3, -1.1396e-2, 3.6155e-2, -1.2805e-2, 1.083e-2],
    [2.5853e-2, 7.796e-3, -1.332e-3, 1.9552e-2, 8.641e-3, 2.8323e-2],
    [3.5549e-2, -2.117e-3, -4.037e-3, 2.9474e-2, 2.29e-4, 8.627e-3],
    [1.964e-3, 1.09e-4, -1.158e-3, 4.354e-3, 3.41e-4, 5.433e-3],
    [1.2516e-2, -4.28e-4, -1.196e-3, 1.0027e-2, -7.41e-4, 4.815e-3],
]
_LIMITS = [[-2.9, 2.9], [-1.8, 1.8], [-2.9, 2.9], [-3.0, 0.0], [-2.9, 2.9], [0.0, 3.8], [-2.9, 2.9]]


def panda(active: int = 7) -> Arm:
    """The Panda with its first `active` joints moving and the others locked at the middle of their limits.

    Raises:
        InputError: `active` is not a number from 1 to 7.
    """
    if active not in range(1, 8):
        raise InputError(f"active is {active!r:.40}; expected 1 to 7 joints")
    rotations, positions = dh_frames(_ROWS)
    inertias = [np.array([m, *np.multiply(m, c), *i]) for m, c, i in zip(_MASSES, _CENTRES, _MOMENTS, strict=True)]
    tree = serial(rotations[:active], positions[:active], inertias[:active])
    rotation, position = np.eye(3), np.zeros(3)
    for link in range(active, 7):
        # Frame of the locked link relative to the last one that moves.
        c, s = np.cos(np.mean(_LIMITS[link])), np.sin(np.mean(_LIMITS[link]))
        position = position + rotation @ positions[link]
        rotation = rotation @ rotations[link] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        tree = with_payload(tree, active - 1, inertias[link], rotation=rotation, position=position)
    return Arm(
        f"panda-{active}",
        tree,
        viscous=np.array([0.0628, 0.2088, 0.0361, 0.2174, 0.1021, 0.0001, 0.0632])[:active],
        coulomb=np.array([0.2549, 0.1413, 0.1879, 0.3625, 0.2728, 0.1529, 0.2097])[:active],
        offset=np.array([-0.1069, -0.1601, -0.0718, -0.2562, 0.0079, 0.0935, -0.0070])[:active],
        limits=np.array(_LIMITS)[:active],
        rates=np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61])[:active],
        accelerations=np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0])[:active],
    )
