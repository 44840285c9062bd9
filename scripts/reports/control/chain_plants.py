"""Chains of three links in a plane with one passive joint, from MJCF files of random sizes."""

from collections.abc import Callable
from functools import partial

import numpy as np

from dln_jax.control.closed_loop import Hardware
from dln_jax.control.plants.mujoco_plants import mujoco_plant
from dln_jax.control.plants.plant import Plant

TURN = 2 * np.pi / 4096
SOLID = 'contype="0" conaffinity="0"'
MOTORS = np.array([4.0, 2.0, 1.0])
"""Largest torques of the joints' motors, N m; the passive joint has none."""


def chain(sizes: int, seed: int, passive: int) -> Plant:
    """A chain of three links of random sizes with motors on two of its joints."""
    random = np.random.default_rng(sizes)
    l1, l2, l3 = random.uniform((0.25, 0.25, 0.2), (0.35, 0.35, 0.3))
    masses = random.uniform((0.3, 0.2, 0.15), (0.5, 0.4, 0.25))
    dry = np.where(np.arange(3) == passive, 0.0, 0.01)
    joints = [f'<joint name="{k}" axis="0 1 0" damping="0.003" frictionloss="{dry[k]}"/>' for k in range(3)]
    rods = [
        f'<geom type="capsule" fromto="0 0 0 0 0 -{length}" size=".012" mass="{mass}" {SOLID}/>'
        for length, mass in zip((l1, l2, l3), masses, strict=True)
    ]
    text = f"""<mujoco><option timestep="0.002" integrator="RK4"/><worldbody><body>{joints[0]}{rods[0]}
      <body pos="0 0 -{l1}">{joints[1]}{rods[1]}<body pos="0 0 -{l2}">{joints[2]}{rods[2]}</body></body></body>
    </worldbody></mujoco>"""
    driven = [k for k in range(3) if k != passive]
    lab = Hardware(encoder_step=TURN, control_noise=0.02, delay=1)
    return mujoco_plant(text, driven, control=MOTORS[driven], hardware=lab, seed=seed)


CHAIN_PLANTS: dict[str, Callable[[int, int], Plant]] = {
    "passive-first": partial(chain, passive=0),
    "passive-middle": partial(chain, passive=1),
    "passive-last": partial(chain, passive=2),
}
"""(seed of the sizes, seed of the start and the noise) -> plant, by name."""
