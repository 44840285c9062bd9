"""Contacts of a two-link arm by a momentum observer: false alarms beside the stated rate, and detected pushes.

Both joints are driven at 500 Hz along sums of sines, with angles from encoders of 2¹⁶ steps a turn. The observer's
model has masses and centres 3 % off, and no dry friction, which the arm has. Rates are those of an extended Kalman
filter with the same model. The threshold comes from recordings without contact; other recordings judge it.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.control.estimate import (
    belief,
    contact_threshold,
    extended,
    filtered,
    mechanical,
    momentum_observer,
    observed,
)
from dln_jax.control.estimate.external import block_maxima
from dln_jax.control.state_space import field_of, integrated
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import FrictionCoefficients, FrictionShape
from dln_jax.scenes.pendulums import Links, two_link_pendulum
from dln_jax.scenes.scene import with_friction
from scripts.reports.case import Findings
from scripts.reports.rows import Row

RATE, STEP, GAIN = 500.0, 2 * np.pi / 2**16, 30.0
SECONDS = 60.0
"""Duration of a recording."""
ALARMS = 60.0
"""Stated false alarms an hour."""
WRONG = 1.03
"""Factor on the model's masses and centres."""
PUSHED = 20
"""Pushes: steps of torque at the elbow, at the middle of short recordings."""
SIZE = 0.5
"""N m."""


def arm_and_model() -> tuple[Any, Any]:
    """Dynamics of the arm, and of the model."""
    friction = FrictionCoefficients(viscous=(0.05, 0.02), coulomb=(0.1, 0.05))
    arm = with_friction(two_link_pendulum(), friction, FrictionShape(velocity_scale=0.02))
    links = Links()
    wrong = links._replace(
        masses=(WRONG * links.masses[0], WRONG * links.masses[1]),
        centres=(WRONG * links.centres[0], WRONG * links.centres[1]),
    )
    nominal = with_friction(
        two_link_pendulum(links=wrong), FrictionCoefficients(viscous=friction.viscous), FrictionShape()
    )
    return dynamics(arm.closed_form), dynamics(nominal.closed_form)


def residuals(seconds: float) -> Callable[[Any, Any], Any]:
    """(key of the motion, push at the elbow from the middle on in N m) -> external torques [N, 2] as observed."""
    arm, model = arm_and_model()
    step, count = integrated(field_of(arm), 1 / RATE, substeps=2), round(seconds * RATE)
    process = mechanical(model, rate=RATE, band=[0.2, 0.1], encoder_step=STEP)
    observer, t = momentum_observer(model, 2, rate=RATE, gain=GAIN), jnp.arange(count) / RATE

    def run(key: Any, push: Any) -> Any:
        of_size, of_phase = jax.random.split(key)
        size = jax.random.uniform(of_size, (5, 2), minval=0.1, maxval=0.4)
        phase = jax.random.uniform(of_phase, (5, 2), maxval=2 * jnp.pi)
        speed = 2 * jnp.pi * jnp.array([0.2, 0.33, 0.5, 0.71, 0.9])[:, None]
        wanted = jnp.sum(size * jnp.sin(speed * t[:, None, None] + phase), axis=1)

        def sample(carry: Any, row: Any) -> Any:
            x, before = carry
            wanted, external = row
            q = STEP * jnp.round(x[:2] / STEP)
            tau = 30 * (wanted - q) - 2.0 * RATE * (q - before)
            return (step(x, tau + external), q), (q, tau)

        external = jnp.where(t[:, None] >= seconds / 2, push * jnp.array([0.0, 1.0]), 0.0)
        first = jnp.concatenate([wanted[0], jnp.zeros(2)])
        _, (q, tau) = jax.lax.scan(sample, (first, first[:2]), (wanted, external))
        x, _ = filtered(extended(process), belief(first, [1e-3, 1e-3, 1.0, 1.0]), q, tau)
        return observed(observer, q, x[:, 2:], tau)

    return run


def contacts(quick: bool) -> Findings:
    """False alarms on recordings that did not set the threshold, and pushes found within half a second."""
    recordings = (2, 4) if quick else (4, 20)
    run = jax.jit(jax.vmap(residuals(SECONDS), in_axes=(0, None)))
    r = np.asarray(run(jax.random.split(jax.random.key(0), sum(recordings)), 0.0))[:, round(RATE) :]
    band = np.sqrt(np.mean(r[: recordings[0]] ** 2, axis=(0, 1)))
    scores = list(np.max(np.abs(r) / band, axis=2))
    threshold = contact_threshold(scores[: recordings[0]], rate=RATE, false_alarms=ALARMS)
    later = block_maxima(scores[recordings[0] :], rate=RATE)
    pushed = jax.jit(jax.vmap(residuals(4.0), in_axes=(0, None)))
    alarm = np.max(np.abs(np.asarray(pushed(jax.random.split(jax.random.key(1), PUSHED), SIZE))) / band, axis=2)
    alarm = alarm[:, round(2.0 * RATE) :] > threshold
    delays = np.where(alarm.any(axis=1), np.argmax(alarm, axis=1) / RATE, np.inf)
    case = "contacts/two-link"
    without, size = f"in {len(later)} s without contact that did not set the threshold", f"of {PUSHED} of {SIZE} N m"
    rows = [
        Row(case, "stated_false_alarms", ALARMS, "1/h"),
        Row(case, "false_alarms", float(np.mean(later > threshold) * 3600), "1/h", expected=without),
        Row(case, "band_shoulder", float(band[0]), "N m", expected="rms without contact"),
        Row(case, "band_elbow", float(band[1]), "N m", expected="rms without contact"),
        Row(case, "threshold", threshold, expected="times the band"),
        Row(case, "pushes_detected", float(np.mean(delays <= 0.5)), expected=size),
        Row(case, "delay_median", float(np.median(delays)), "s"),
    ]
    return Findings(rows)
