"""Swing-ups of a desktop plant on its simulated hardware, by any model of it: one run, or the outcomes of many."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.control.closed_loop import Run, simulate, with_differences
from dln_jax.control.desktop_plants import DesktopPlant
from dln_jax.control.outcomes import Outcomes, hanging_starts, outcomes
from dln_jax.control.state_space import field_of
from dln_jax.control.swing_up import SwingUp, SwingUpNumbers, swing_up
from dln_jax.mechanics.dynamics import Dynamics, PlainDynamics
from dln_jax.mechanics.equations import dynamics

SECONDS = 10.0
CUTOFF = 50.0
"""Cut-off frequency of the rates, which are differences of encoder readings, Hz."""
POSTURES = 65
"""Number of pole angles around the circle at which a model has to be usable."""


class Tried(NamedTuple):
    """Swing-ups from n initial states."""

    outcomes: Outcomes
    farthest: Float[np.ndarray, " n"]
    """Largest displacement of the driven coordinate, m or rad."""


def model_of_plant(plant: DesktopPlant) -> Dynamics:
    """The true plant with its friction, which is unknown in practice."""
    return dynamics(plant.scene.closed_form)


def nominal_model(plant: DesktopPlant) -> Dynamics:
    """Model with the manufacturer's sizes, without friction."""
    return dynamics(plant.nominal(**plant.sizes).closed_form)


def law_of(plant: DesktopPlant, model: Dynamics | PlainDynamics, numbers: SwingUpNumbers | None = None) -> SwingUp:
    """Returns the plant's swing-up by a model, with the plant's own numbers by default. Raises as `swing_up`."""
    angle = np.linspace(-np.pi, np.pi, POSTURES)
    needs, lab = plant.scene.needs, plant.hardware
    return swing_up(
        model, needs.actuation, needs.joints, np.zeros(2), plant.numbers if numbers is None else numbers,
        postures=np.stack([np.zeros(POSTURES), angle], axis=1), least=lab.least, most=lab.most,
    )  # fmt: skip


def motion_of(
    plant: DesktopPlant,
    model: Dynamics | PlainDynamics,
    numbers: SwingUpNumbers | None = None,
    *,
    seconds: float = SECONDS,
) -> Callable[[Array, Array], Run]:
    """(initial state [4], key of the noise) -> a run of the true plant with the model's law."""
    law = law_of(plant, model, numbers).law
    controller = with_differences(law, 2, rate=plant.rate, cutoff=CUTOFF)
    field, B = field_of(model_of_plant(plant), plant.scene.needs.actuation), np.asarray(plant.scene.needs.actuation)

    def run(x: Array, key: Array) -> Run:
        return simulate(
            field, controller, x, seconds=seconds, rate=plant.rate, controls=B.shape[1],
            hardware=plant.hardware, key=key, substeps=plant.substeps,
        )  # fmt: skip

    return run


def try_starts(
    plant: DesktopPlant,
    model: Dynamics | PlainDynamics,
    numbers: SwingUpNumbers | None = None,
    *,
    starts: int = 1000,
    seed: int = 0,
    seconds: float = SECONDS,
) -> Tried:
    """Runs swing-ups from random states near hanging, with independent noise."""
    run = motion_of(plant, model, numbers, seconds=seconds)

    def watched(x: Array, key: Array) -> tuple[Array, Array]:
        states = run(x, key).x
        return states[:, 1], jnp.max(jnp.abs(states[:, 0]))

    x = hanging_starts(starts, seed, position=plant.position)
    angle, far = jax.jit(jax.vmap(watched))(x, jax.random.split(jax.random.key(seed), starts))
    return Tried(outcomes(angle, rate=plant.rate), np.asarray(far))
