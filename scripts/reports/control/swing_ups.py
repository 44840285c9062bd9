"""Swing-ups of plants of desktop size by known models, from many starts on simulated hardware."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control import (
    ClosedLoopRun,
    EnergyGains,
    Hardware,
    energy_shaping,
    field_of,
    holding_controls,
    linearise,
    lqr,
    parts_of,
    regulated,
    simulate,
    switched,
    value,
    with_differences,
)
from dln_jax.control.closed_loop import Outcomes, hanging_starts, outcomes
from dln_jax.control.desktop_plants import TURN
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.poles import cart_pole, rotary_pendulum
from dln_jax.scenes.scene import Scene
from scripts.reports.case import Findings
from scripts.reports.rows import Row

RATE, SECONDS, CUTOFF = 500.0, 10.0, 50.0
"""Rate of the controller, Hz, length of a run, s, and cut-off of the rates, Hz."""
STARTS, SUCCESS = 1000, 0.995
FASTEST = 15.0
"""Largest rate of the pole at the start, rad/s; the driven joint starts at rest at zero."""


class SwingUp(NamedTuple):
    """A plant with one free pole, and the numbers of its law."""

    scene: Scene
    gains: EnergyGains
    state_cost: np.ndarray
    control_cost: float
    limit: float
    """Limit of force or torque, N or N m."""
    level: float
    """Level of the regulator's value function at which it takes over."""
    encoder_step: tuple[float, float]
    """Resolution of the encoders, m or rad."""
    position: float
    """Standard deviation of the driven coordinate at the start, m or rad."""


SWING_UPS = {
    "cart-pole": SwingUp(
        scene=cart_pole(cart_mass=0.57, pole_mass=0.127, length=0.16825, friction=0.002),
        gains=EnergyGains(2000.0, 10.0, 4.0),
        state_cost=np.diag([10.0, 1.0, 0.1, 0.1]),
        control_cost=0.1,
        limit=10.0,
        level=1.0,
        encoder_step=(2.3e-5, TURN),
        position=0.02,
    ),
    "rotary-pendulum": SwingUp(
        scene=rotary_pendulum(friction=1e-5),
        gains=EnergyGains(2e7, 20.0, 5.0),
        state_cost=np.diag([1.0, 1.0, 0.01, 0.01]),
        control_cost=50.0,
        limit=0.05,
        level=0.1,
        encoder_step=(TURN, TURN),
        position=0.1,
    ),
}


class Parts(NamedTuple):
    """A regulator, its value function, and the law by energy, of the state x [4]."""

    regulator: Callable[[Array], Array]
    value: Callable[[Array], Array]
    by_energy: Callable[[Array], Array]


def parts_of_law(case: SwingUp) -> Parts:
    """The parts of the law that `law_of` switches between."""
    system, B, joints = dynamics(case.scene.energies), np.asarray(case.scene.needs.actuation), case.scene.needs.joints
    goal = jnp.zeros(4)
    at = linearise(field_of(system, B), goal, holding_controls(system, goal[:2], B))
    gains = lqr(at.A, at.B, case.state_cost, [[case.control_cost]])
    swing = energy_shaping(system, parts_of(B), goal[:2], case.gains)
    return Parts(regulated(gains, goal, at.u, joints), value(gains, goal, joints), lambda x: swing(x[:2], x[2:]))


def law_of(case: SwingUp) -> Callable[[Array], Array]:
    """The law by energy, and the regulator where its value is below the level."""
    near, cost, far = parts_of_law(case)
    return switched(far, near, cost, case.level)


def closed_loop(case: SwingUp, *, seconds: float = SECONDS) -> Callable[[Array], ClosedLoopRun]:
    """Start [4] -> run on simulated hardware: only encoders are read, rates are their differences, and torques act one
    sample late."""
    field = field_of(dynamics(case.scene.energies), np.asarray(case.scene.needs.actuation))
    controller = with_differences(law_of(case), 2, rate=RATE, cutoff=CUTOFF)
    lab = Hardware(-case.limit, case.limit, encoder_step=np.array(case.encoder_step), delay=1, sees_rates=False)
    return lambda start: simulate(field, controller, start, seconds=seconds, rate=RATE, controls=1, hardware=lab)


def tried(case: SwingUp, starts: np.ndarray, *, seconds: float = SECONDS) -> Outcomes:
    """Outcomes from these starts [K, 4]."""
    run = closed_loop(case, seconds=seconds)
    return outcomes(jax.jit(jax.vmap(lambda start: run(start).x[:, 1]))(starts), rate=RATE)


def swing_up(name: str, quick: bool) -> Findings:
    """Share of starts near hanging that are up after ten seconds, and the time it takes."""
    case = SWING_UPS[name]
    result = tried(case, hanging_starts(50 if quick else STARTS, 0, position=case.position))
    words = f"of {len(result.seconds)} starts near hanging, on simulated hardware"
    return Findings(_rows(f"swing-up/{name}/known", result, words, SUCCESS))


def from_anywhere(name: str, quick: bool) -> Findings:
    """Share of starts over the pole's phase plane that are up after ten seconds."""
    random, x = np.random.default_rng(1), np.zeros((50 if quick else STARTS, 4))
    x[:, 1], x[:, 3] = random.uniform(-np.pi, np.pi, len(x)), random.uniform(-FASTEST, FASTEST, len(x))
    result = tried(SWING_UPS[name], x)
    words = f"of {len(x)} starts at any angle of the pole and |rate| <= {FASTEST:g} rad/s, on simulated hardware"
    return Findings(_rows(f"starts/{name}/known", result, words))


def _rows(case: str, result: Outcomes, words: str, bound: float | None = None) -> list[Row]:
    """Share of successes, number of NaN runs, and median and worst time."""
    return [
        Row(case, "success_share", result.share, expected=words, bound=bound, at_least=True),
        Row(case, "no_number", float(result.failed.sum()), expected="runs, counted as failures"),
        Row(case, "seconds_median", result.median, "s"),
        Row(case, "seconds_worst", result.worst, "s"),
    ]
