"""State estimation on the desktop plants: torque at the goal, swing-ups and rates by filters, beside differences.

The process of every filter is tuned on 30 s of exploration, as a user would: q by encoders and commanded torques. All
estimators drive the same law on the same plant, from the same starts and with the same noise. "exact-state" gives the
law the true state at the time when its control acts: what no estimator can improve on, because friction remains.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.control.closed_loop import Controller, Hardware, hanging_starts, outcomes, simulate
from dln_jax.control.desktop_plants import (
    SECONDS,
    DesktopPlant,
    desktop_plant,
    law_of,
    model_of_plant,
    nominal_model,
)
from dln_jax.control.estimate import belief, extended, filtered, from_log, unscented
from dln_jax.control.estimate.process import Process
from dln_jax.control.plants.estimators import by_differences, by_filter
from dln_jax.control.state_space import Law, field_of, integrated, saturated
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.training.swing_ups.learned import obtain, recorded
from scripts.reports.case import Findings
from scripts.reports.rows import Row

HELD = 2.0
"""Last part of a run, for judging the torque, s."""
STARTS = 1000
"""Starts with the default filter and with differences, by the known model."""
FEWER_STARTS, QUICK_STARTS = 100, 30
"""Starts with other estimators and models, which are compared by medians, and of a quick run."""
QUIETER = 0.2
"""Largest rms of the torque at the goal, as a share of that by differences."""
CLOSER = 0.5
"""Largest rms error of rates, as a share of that by differences."""
LOGGED = 3.0
"""s: length of the swing-up along which rates are compared."""


class Held(NamedTuple):
    """Runs with one estimator."""

    share: float
    """Share of the starts that end upright."""
    rms: np.ndarray
    """[n], root mean square of the commands at the goal, N m or N."""
    change: np.ndarray
    """[n], root mean square change of the command between samples."""
    reversals: np.ndarray
    """[n], changes of the command's sign a second."""


def models(plant: DesktopPlant, recording: Any) -> dict[str, Callable[[], Dynamics]]:
    """Models for the law and the filter."""
    return {
        "known": lambda: model_of_plant(plant),
        "identified": lambda: obtain(plant, "identified", recording, seed=0).dynamics,
        "analytic": lambda: nominal_model(plant),
    }


def exact(plant: DesktopPlant) -> Callable[[Law], Controller]:
    """The true state when the next control acts, from the true state now."""
    B, hardware = np.asarray(plant.scene.needs.actuation), plant.hardware
    step = integrated(field_of(model_of_plant(plant), B), 1 / plant.rate, substeps=plant.substeps)

    def make(law: Law) -> Controller:
        def act(u: Any, t: Any, x: Any) -> tuple[Any, Any]:
            u = saturated(law(step(x, u)), hardware.lower, hardware.upper)
            return u, u

        return Controller(jnp.zeros(1), act)

    return make


def held(plant: DesktopPlant, model: Dynamics, make: Callable[[Law], Controller], starts: int, *, sees: bool) -> Held:
    """Swing-ups from many starts, and the commands at the goal; with `sees`, the controller receives true states."""
    controller, B = make(law_of(plant, model).law), np.asarray(plant.scene.needs.actuation)
    hardware = plant.hardware._replace(encoder_step=0.0, sees_rates=True) if sees else plant.hardware
    field, last = field_of(model_of_plant(plant), B), round(HELD * plant.rate)

    def one(x: Any, key: Any) -> tuple[Any, ...]:
        run = simulate(
            field, controller, x, seconds=SECONDS, rate=plant.rate, controls=1, hardware=hardware, key=key,
            substeps=plant.substeps,
        )  # fmt: skip
        u = commands(controller, plant, run.t[:-1], run.y)[1][-last:, 0]
        change = jnp.diff(u)
        flips = jnp.sum(jnp.sign(u[1:]) * jnp.sign(u[:-1]) < 0) / HELD
        return run.x[:, 1], jnp.sqrt(jnp.mean(u**2)), jnp.sqrt(jnp.mean(change**2)), flips

    x = hanging_starts(starts, 0, position=plant.position)
    angle, rms, change, flips = jax.jit(jax.vmap(one))(x, jax.random.split(jax.random.key(0), starts))
    return Held(outcomes(angle, rate=plant.rate).share, *map(np.asarray, (rms, change, flips)))


def commands(controller: Controller, plant: DesktopPlant, t: Any, y: Any) -> tuple[Any, Any]:
    """Memories after every sample, and commands without the actuator's noise, along measurements."""

    def sample(memory: Any, row: tuple[Any, Any]) -> tuple[Any, Any]:
        memory, u = controller.act(memory, *row)
        return memory, (memory, saturated(u, plant.hardware.lower, plant.hardware.upper))

    return jax.lax.scan(sample, controller.start, (t, y))[1]


def chatter(name: str, model: str, quick: bool) -> Findings:
    """Swing-ups and the torque at the goal, by differences, by two filters and by the exact state."""
    plant = desktop_plant(name)
    recording = recorded(plant, seconds=30.0, seed=0)
    dynamics = models(plant, recording)[model]()
    B, unit = np.asarray(plant.scene.needs.actuation), "N" if name == "cart-pole" else "N m"
    process = from_log(dynamics, recording, actuation=B, delay=plant.hardware.delay).process
    estimators = {
        "differences": by_differences(plant.layout),
        "extended": by_filter(plant.layout, process, delay=plant.hardware.delay),
        "unscented": by_filter(plant.layout, process, delay=plant.hardware.delay, make=unscented),
        "exact-state": exact(plant),
    }
    rows, before = [], np.nan
    for key, make in estimators.items():
        whole = model == "known" and key in ("differences", "extended")
        starts = QUICK_STARTS if quick else STARTS if whole else FEWER_STARTS
        result = held(plant, dynamics, make, starts, sees=key == "exact-state")
        case, rms = f"estimates/{name}/{model}/{key}", float(np.median(result.rms))
        judged = key in ("extended", "unscented")
        before = rms if key == "differences" else before
        rows += [
            Row(case, "success_share", result.share, bound=1.0 if judged else None, at_least=True,
                expected=f"of {starts} starts near hanging"),
            Row(case, "torque_rms", rms, unit, expected="median over starts, of the last 2 s"),
            Row(case, "torque_rms_ratio", rms / before, bound=QUIETER if judged else None, expected="to differences"),
            Row(case, "torque_change_rms", float(np.median(result.change)), unit, expected="from sample to sample"),
            Row(case, "reversals_per_second", float(np.median(result.reversals)), "1/s"),
        ]  # fmt: skip
    return Findings(rows + rates(plant, dynamics, process, f"estimates/{name}/{model}"))


def rates(plant: DesktopPlant, model: Dynamics, process: Process, case: str) -> list[Row]:
    """Errors of the rates along one swing-up that differences drive; each coordinate relative to differences'."""
    law = law_of(plant, model).law
    controller, B = by_differences(plant.layout)(law), np.asarray(plant.scene.needs.actuation)
    hardware: Hardware = plant.hardware
    start = hanging_starts(1, 7, position=plant.position)[0]
    prior = belief([0.0, np.pi, 0.0, 0.0], [1.0, np.pi, 1.0, 1.0])

    @jax.jit
    def log() -> tuple[Any, ...]:
        run = simulate(
            field_of(model_of_plant(plant), B), controller, start, seconds=LOGGED, rate=plant.rate, controls=1,
            hardware=hardware, key=jax.random.key(7), substeps=plant.substeps,
        )  # fmt: skip
        memories, asked = commands(controller, plant, run.t[:-1], run.y)
        # Controls act a sample after they are commanded.
        return run.x[:-1, 2:], memories[0][2], run.y, jnp.concatenate([jnp.zeros((1, 1)), asked[:-1]])

    true, by_difference, y, u = log()
    rms = lambda qd: np.sqrt(np.mean((np.asarray(qd) - np.asarray(true)) ** 2, axis=0))  # noqa: E731
    before, rows = rms(by_difference), []
    filters = {"extended": extended, "unscented": unscented}
    for key, make in filters.items():
        error = rms(jax.jit(lambda make=make: filtered(make(process), prior, y, u)[0][:, 2:])())
        for joint, value, other in zip(("driven", "pole"), error, before, strict=True):
            rows += [
                Row(f"{case}/{key}", f"{joint}_rate_error", float(value), "m/s or rad/s"),
                Row(f"{case}/{key}", f"{joint}_rate_error_ratio", float(value / other), bound=CLOSER,
                    expected="to differences, along one swing-up"),
            ]  # fmt: skip
    return rows


CASES: dict[str, Callable[[bool], Findings]] = {
    f"estimates/{name}-{model}": partial(chatter, name, model)
    for name in ("rotary-pendulum", "cart-pole")
    for model in ("known", "identified", "analytic")
}
