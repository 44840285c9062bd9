"""Two desktop plants: friction, limits, encoders, noise and delay, defined in one place.

| | cart-pole | rotary pendulum |
|---|---|---|
| sizes | Quanser's (Lutter, Listmann and Peters 2019) | those of `scenes.rotary_pendulum`, QUBE-like |
| limit | 10 N | 0.05 N m |
| dry friction of the driven joint | 0.3 N, 3 % of the limit, 0.4 N at rest | 1.5 mN m, 3 %, 2 mN m at rest |
| viscous friction of it | 0.1 N s/m | 0.1 mN m s |
| dry friction of the pole's hinge | 0.5 mN m, 0.2 % of its weight's torque | 0.05 mN m, 0.3 % |
| viscous friction of it | 1 mN m s | 0.01 mN m s |
| encoders | 23 µm; 2048 a turn | 2048 a turn |
| noise of the force | 0.05 N | 0.25 mN m |

Both run at 500 Hz, with forces delayed by one sample. Stiction is dry friction below 5 mm/s or 10 mrad/s.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from dln_jax.control.closed_loop import Hardware
from dln_jax.control.energy_shaping import EnergyGains
from dln_jax.control.swing_up import SwingUpNumbers
from dln_jax.mechanics.friction import FrictionCoefficients, FrictionShape
from dln_jax.scenes.cart_pole import cart_pole
from dln_jax.scenes.friction import with_friction
from dln_jax.scenes.rotary_pendulum import rotary_pendulum
from dln_jax.scenes.scene import Scene
from dln_jax.types import InputError

TURN = 2 * np.pi / 2048
"""Resolution of an encoder, rad."""


class DesktopPlant(NamedTuple):
    """A plant with one motor and one free pole to swing up, with its sensors and actuators."""

    scene: Scene
    """Scene with the plant's friction."""
    nominal: Callable[..., Scene]
    """Builds the manufacturer's model, without friction, from its sizes."""
    sizes: Mapping[str, float]
    """True masses in kg and lengths in m."""
    hardware: Hardware
    rate: float
    """Sampling rate of the controller, Hz."""
    substeps: int
    """Integrator steps per sample, enough to resolve stiction."""
    numbers: SwingUpNumbers
    """Numbers of its swing-up, tuned by a random search with the analytic model."""
    position: float
    """Standard deviation of the driven coordinate's initial value, m or rad."""


def desktop_cart_pole() -> DesktopPlant:
    """Returns a cart on a rail."""
    sizes = {"cart_mass": 0.57, "pole_mass": 0.127, "length": 0.16825}
    friction = FrictionCoefficients(viscous=(0.1, 1e-3), coulomb=(0.3, 5e-4), stribeck=(0.1, 2e-4))
    shape = FrictionShape(velocity_scale=(0.005, 0.01), stribeck_velocity=(0.05, 0.1))
    lab = Hardware(-10.0, 10.0, encoder_step=np.array([2.3e-5, TURN]), control_noise=0.05, delay=1, sees_rates=False)
    numbers = SwingUpNumbers(
        EnergyGains(1100.0, 21.0, 4.7),
        np.diag([10.0, 10.0, 1.0, 0.1]),
        np.array([[0.1]]),
        3.8,
        smoothing=0.05,
        kick=5.0,
    )
    scene = with_friction(cart_pole(**sizes), friction, shape)
    return DesktopPlant(scene, cart_pole, sizes, lab, 500.0, 2, numbers, 0.02)


def desktop_rotary_pendulum() -> DesktopPlant:
    """Returns a pendulum on the arm of a motor's shaft."""
    sizes = {"arm_mass": 0.095, "arm_length": 0.085, "pole_mass": 0.024, "pole_length": 0.129}
    friction = FrictionCoefficients(viscous=(1e-4, 1e-5), coulomb=(1.5e-3, 5e-5), stribeck=(5e-4, 2e-5))
    shape = FrictionShape(velocity_scale=(0.01, 0.01), stribeck_velocity=(0.1, 0.1))
    lab = Hardware(-0.05, 0.05, encoder_step=np.array([TURN, TURN]), control_noise=2.5e-4, delay=1, sees_rates=False)
    numbers = SwingUpNumbers(
        EnergyGains(4.3e7, 32.0, 11.0),
        np.diag([1.0, 1.0, 0.01, 0.01]),
        np.array([[50.0]]),
        0.07,
        smoothing=1.0,
        kick=0.025,
    )
    scene = with_friction(rotary_pendulum(**sizes), friction, shape)
    return DesktopPlant(scene, rotary_pendulum, sizes, lab, 500.0, 2, numbers, 0.1)


PLANTS: Mapping[str, Callable[[], DesktopPlant]] = {
    "cart-pole": desktop_cart_pole,
    "rotary-pendulum": desktop_rotary_pendulum,
}
NAMES = {**{name: name for name in PLANTS}, "furuta": "rotary-pendulum"}
"""Names of the plants, with their aliases."""


def desktop_plant(name: str) -> DesktopPlant:
    """Returns the plant of this name; `InputError` lists the names."""
    if name not in NAMES:
        raise InputError(f"plant is {name!r:.40}; choose from {', '.join(NAMES)}")
    return PLANTS[NAMES[name]]()
