"""Two desktop plants with friction, limits, encoders, noise and delay, and their swing-ups by any model.

The cart-pole has Quanser's sizes (Lutter, Listmann and Peters 2019); the rotary pendulum has those of
`scenes.pendulums`, similar to a QUBE. Dry friction of the driven joint is 3 % of the limit, and a third more at rest;
that of the pole's hinge is 0.2 % (cart-pole) or 0.3 % of the torque of its weight. Both plants run at 500 Hz, with
forces delayed by one sample. Below 5 mm/s or 10 mrad/s, dry friction stands in for stiction.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.control.closed_loop import ClosedLoopRun, Hardware, Outcomes, Push, hanging_starts, outcomes, simulate
from dln_jax.control.energy_shaping import EnergyGains
from dln_jax.control.plants.estimators import Estimator, by_differences
from dln_jax.control.plants.plant import Layout, Plant, layout, plant_of
from dln_jax.control.state_space import field_of
from dln_jax.control.swing_up import SwingUp, SwingUpNumbers, Upright, swing_up, upright_of
from dln_jax.mechanics.dynamics import Dynamics, InverseForward
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import FrictionCoefficients, FrictionShape
from dln_jax.scenes.pendulums import cart_pole, rotary_pendulum
from dln_jax.scenes.scene import Scene, with_friction
from dln_jax.types import InputError

TURN = 2 * np.pi / 2048
"""Resolution of an encoder, rad."""
SECONDS = 10.0
"""Duration of a simulated swing-up, s."""
HOLDING = 1.0
"""Time at the end of a run for which the pole must be upright, s."""
POSTURES = 65
"""Number of pole angles around the circle; a model must be usable at all of them."""


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
    """Settings of its swing-up, tuned by random search with the analytic model."""
    position: float
    """Standard deviation of the driven coordinate's initial value, m or rad."""

    @property
    def layout(self) -> Layout:
        """Returns what is known of the plant before it has moved."""
        return layout(
            self.scene.needs.joints, [0], goal=np.zeros(2), hanging=[0.0, np.pi], rate=self.rate,
            control=self.hardware.upper,
        )  # fmt: skip


class Tried(NamedTuple):
    """Swing-ups from n initial states."""

    outcomes: Outcomes
    farthest: Float[np.ndarray, " n"]
    """Largest displacement of the driven coordinate, m or rad."""
    effort: Float[np.ndarray, " n"]
    """Root mean square control in the last second, N m or N."""


def desktop_cart_pole() -> DesktopPlant:
    """Returns a cart on a rail, with a pole."""
    sizes = {"cart_mass": 0.57, "pole_mass": 0.127, "length": 0.16825}
    friction = FrictionCoefficients(viscous=(0.1, 1e-3), coulomb=(0.3, 5e-4), stribeck=(0.1, 2e-4))
    shape = FrictionShape(velocity_scale=(0.005, 0.01), stribeck_velocity=(0.05, 0.1))
    hardware = Hardware(
        -10.0, 10.0, encoder_step=np.array([2.3e-5, TURN]), control_noise=0.05, delay=1, sees_rates=False
    )
    gains, Q, R = EnergyGains(1100.0, 21.0, 4.7), np.diag([10.0, 10.0, 1.0, 0.1]), np.array([[0.1]])
    numbers = SwingUpNumbers(gains, Q, R, level=3.8, smoothing=0.05, kick=5.0)
    scene = with_friction(cart_pole(**sizes), friction, shape)
    return DesktopPlant(scene, cart_pole, sizes, hardware, 500.0, 2, numbers, 0.02)


def desktop_rotary_pendulum() -> DesktopPlant:
    """Returns a pendulum on an arm that a motor turns."""
    sizes = {"arm_mass": 0.095, "arm_length": 0.085, "pole_mass": 0.024, "pole_length": 0.129}
    friction = FrictionCoefficients(viscous=(1e-4, 1e-5), coulomb=(1.5e-3, 5e-5), stribeck=(5e-4, 2e-5))
    shape = FrictionShape(velocity_scale=(0.01, 0.01), stribeck_velocity=(0.1, 0.1))
    hardware = Hardware(
        -0.05, 0.05, encoder_step=np.array([TURN, TURN]), control_noise=2.5e-4, delay=1, sees_rates=False
    )
    gains, Q, R = EnergyGains(4.3e7, 32.0, 11.0), np.diag([1.0, 1.0, 0.01, 0.01]), np.array([[50.0]])
    numbers = SwingUpNumbers(gains, Q, R, level=0.07, smoothing=1.0, kick=0.025)
    scene = with_friction(rotary_pendulum(**sizes), friction, shape)
    return DesktopPlant(scene, rotary_pendulum, sizes, hardware, 500.0, 2, numbers, 0.1)


PLANTS: Mapping[str, Callable[[], DesktopPlant]] = {
    "cart-pole": desktop_cart_pole,
    "rotary-pendulum": desktop_rotary_pendulum,
}
NAMES = {**{name: name for name in PLANTS}, "furuta": "rotary-pendulum"}
"""Names of the plants, with their aliases."""


def desktop_plant(name: str) -> DesktopPlant:
    """Returns the plant with this name; for an unknown name, `InputError` lists the known ones."""
    if name not in NAMES:
        raise InputError(f"plant is {name!r:.40}; choose from {', '.join(NAMES)}, or a file")
    return PLANTS[NAMES[name]]()


def model_of_plant(plant: DesktopPlant) -> Dynamics:
    """Returns the true plant with its friction, which is unknown in practice."""
    return dynamics(plant.scene.closed_form)


def nominal_model(plant: DesktopPlant) -> Dynamics:
    """Returns the model with the manufacturer's sizes, without friction."""
    return dynamics(plant.nominal(**plant.sizes).closed_form)


def simulated_plant(plant: DesktopPlant, *, seed: int = 0) -> Plant:
    """Returns the plant as callables, as for any plant; the seed determines its starts and its noise."""
    return plant_of(
        model_of_plant(plant), plant.layout, substeps=plant.substeps, hardware=plant.hardware, seed=seed
    )  # fmt: skip


def law_of(plant: DesktopPlant, model: Dynamics | InverseForward, estimator: Estimator | None = None) -> SwingUp:
    """Returns the plant's swing-up by a model, by default with rates from differences; raises as `swing_up`."""
    needs, hardware = plant.scene.needs, plant.hardware
    return swing_up(
        model, needs.actuation, needs.joints, np.zeros(2), plant.numbers, postures=_circle(), lower=hardware.lower,
        upper=hardware.upper, estimator=estimator or by_differences(plant.layout),
    )  # fmt: skip


def upright_for(plant: DesktopPlant, model: Dynamics | InverseForward) -> Upright:
    """Returns the checked model with its equilibrium near the goal; raises as `swing_up`."""
    return upright_of(
        model, plant.scene.needs.actuation, np.zeros(2), postures=_circle(), lower=plant.hardware.lower,
        upper=plant.hardware.upper,
    )  # fmt: skip


def _circle() -> np.ndarray:
    angle = np.linspace(-np.pi, np.pi, POSTURES)
    return np.stack([np.zeros(POSTURES), angle], axis=1)


def motion_of(
    plant: DesktopPlant,
    model: Dynamics | InverseForward,
    *,
    seconds: float = SECONDS,
    estimator: Estimator | None = None,
    push: Push | None = None,
) -> Callable[[Array, Array], ClosedLoopRun]:
    """Returns (initial state [4], key of the noise) -> run of the true plant under the law of `law_of`."""
    controller = law_of(plant, model, estimator).controller
    B = np.asarray(plant.scene.needs.actuation)
    field = field_of(model_of_plant(plant), B)

    def run(x: Array, key: Array) -> ClosedLoopRun:
        return simulate(
            field, controller, x, seconds=seconds, rate=plant.rate, controls=B.shape[1],
            hardware=plant.hardware, key=key, substeps=plant.substeps, push=push,
        )  # fmt: skip

    return run


def try_starts(
    plant: DesktopPlant,
    model: Dynamics | InverseForward,
    *,
    starts: int = 1000,
    seed: int = 0,
    seconds: float = SECONDS,
    estimator: Estimator | None = None,
    push: Push | None = None,
) -> Tried:
    """Runs swing-ups from random states near hanging, with independent noise; other arguments as for `motion_of`."""
    run = motion_of(plant, model, seconds=seconds, estimator=estimator, push=push)
    held = min(round(HOLDING * plant.rate), round(seconds * plant.rate))

    def extremes(x: Array, key: Array) -> tuple[Array, Array, Array]:
        motion = run(x, key)
        return motion.x[:, 1], jnp.max(jnp.abs(motion.x[:, 0])), jnp.sqrt(jnp.mean(motion.u[-held:] ** 2))

    x = hanging_starts(starts, seed, position=plant.position)
    angle, far, effort = jax.jit(jax.vmap(extremes))(x, jax.random.split(jax.random.key(seed), starts))
    return Tried(outcomes(angle, rate=plant.rate), np.asarray(far), np.asarray(effort))
