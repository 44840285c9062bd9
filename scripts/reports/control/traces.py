"""Figures of swing-ups: some runs from near hanging, and the time to swing up over the phase plane."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from dln_jax.control import ClosedLoopRun
from dln_jax.control.closed_loop import hanging_starts
from dln_jax.figures.closed_loops import closed_loop_traces, success_over_starts
from dln_jax.mechanics.equations import dynamics
from scripts.reports.case import Findings
from scripts.reports.control.energy_laws import SwingUp, closed_loop, rows_of_outcomes, tried
from scripts.reports.figures.starts import success_over_starts

SHOWN, SECONDS, EVERY = 6, 3.0, 4
"""Runs in a figure, their length, s, and the stride of the drawn samples."""
ANYWHERE = 1000
"""Number of starts over the phase plane."""
FASTEST = 15.0
"""Largest rate of the pole at the start, rad/s; the driven joint starts at rest at zero."""


def traces(case: SwingUp) -> dict[str, list[float]]:
    """Runs as lists of numbers, which a report can store."""
    run = jax.jit(jax.vmap(closed_loop(case, seconds=SECONDS)))(hanging_starts(SHOWN, 0, position=case.position))
    energy = dynamics(case.scene.energies).energy
    x = run.x[:, ::EVERY]
    joules = jax.jit(jax.vmap(jax.vmap(lambda x: energy(x[:2], x[2:]))))(x)
    revolute = [float(kind == "revolute") for kind in case.scene.needs.joints]
    numbers: dict[str, Any] = {"t": run.t[0, ::EVERY], "x": x, "u": run.u[:, ::EVERY], "energy": joules}
    goal = float(energy(jnp.zeros(2), jnp.zeros(2)))
    stated = {"limit": [case.limit], "goal_energy": [goal], "revolute": revolute}
    return {**{name: np.ravel(each).tolist() for name, each in numbers.items()}, **stated}


def draw_traces(curves: Mapping[str, Any]) -> Figure:
    """Draws the result of `traces`."""
    t, d = np.array(curves["t"]), len(curves["revolute"])
    x = np.reshape(curves["x"], (-1, len(t), 2 * d))
    u = np.reshape(curves["u"], (len(x), -1, 1))[:, : len(t) - 1]
    runs = ClosedLoopRun(jnp.asarray(t), jnp.asarray(x), jnp.asarray(u), jnp.zeros((len(x), len(t) - 1, d)))
    limit, (goal,) = curves["limit"][0], curves["goal_energy"]
    sliding = curves["revolute"][0] == 0.0
    return closed_loop_traces(
        runs, ("prismatic" if sliding else "revolute", "revolute"), names=("cart" if sliding else "arm", "pole"),
        limits=(-limit, limit), unit="N" if sliding else "N m",
        energy=np.reshape(curves["energy"], x.shape[:2]), goal_energy=goal,
    )  # fmt: skip


def from_anywhere(case: SwingUp, quick: bool) -> Findings:
    """Share of starts over the pole's phase plane that are up after ten seconds."""
    random = np.random.default_rng(1)
    x = np.zeros((50 if quick else ANYWHERE, 4))
    x[:, 1], x[:, 3] = random.uniform(-np.pi, np.pi, len(x)), random.uniform(-FASTEST, FASTEST, len(x))
    found = tried(case, x)
    words = f"of {len(x)} starts at any angle of the pole and |rate| <= {FASTEST:g} rad/s, on simulated hardware"
    rows = rows_of_outcomes(f"starts/{case.scene.name}/known", found, words)
    return Findings(rows, {"angle": x[:, 1].tolist(), "rate": x[:, 3].tolist(), "seconds": found.seconds.tolist()})


def draw_starts(curves: Mapping[str, Any]) -> Figure:
    """Draws the result of `from_anywhere`."""
    return success_over_starts(np.stack([curves["angle"], curves["rate"]], axis=1), np.array(curves["seconds"]))


DRAWN: dict[str, Callable[[dict[str, Any]], Figure]] = {"swing-up": draw_traces, "starts": draw_starts}
"""Functions that draw a subject's curves."""
