"""A rotary pendulum of desktop size with dry friction, encoders as its only sensors, noise and a sample of delay."""

import numpy as np

from dln_jax.control.closed_loop import Hardware
from dln_jax.control.plants.plant import layout, plant_of
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import FrictionCoefficients
from dln_jax.scenes.pendulums import rotary_pendulum
from dln_jax.scenes.scene import with_friction

NOMINAL = dynamics(rotary_pendulum().closed_form)
SCENE = with_friction(rotary_pendulum(), FrictionCoefficients(viscous=(1e-4, 1e-5), coulomb=(1.5e-3, 5e-5)))
TRUTH = dynamics(SCENE.closed_form)
LIMIT = 0.05
LAYOUT = layout(("revolute", "revolute"), [0], goal=(0, 0), hanging=(0, np.pi), rate=500.0, control=LIMIT)
STEP = 2 * np.pi / 2048
HARDWARE = Hardware(-LIMIT, LIMIT, encoder_step=STEP, control_noise=2.5e-4, delay=1, sees_rates=False)


def simulated_furuta(seed=0):
    """The plant as callables."""
    return plant_of(TRUTH, LAYOUT, substeps=2, hardware=HARDWARE, seed=seed)
