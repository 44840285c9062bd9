"""A simulated motion: the chunks that compute it, its metrics, warnings and figures."""

import functools
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.commands.simulations.scenes import PreparedScene, in_precision
from dln_jax.figures.soft_bodies import Moments, energies_against_time, moments_figure, soft_body_drawing
from dln_jax.figures.style import write_gif
from dln_jax.files import write_figure
from dln_jax.metrics.report import Row
from dln_jax.metrics.soft_body_energies import motion_energies
from dln_jax.rollout import rollout
from dln_jax.runs.progress import progress
from dln_jax.runs.report import png
from dln_jax.softbody.contact.crossings import count_overlaps
from dln_jax.softbody.examples import Example, inputs
from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.mesh.simplices import volume_ratios
from dln_jax.softbody.scene import Params, State
from dln_jax.softbody.verdict import Info

CHUNKS = 20
"""Number of chunks a motion is split into; progress is shown after every chunk."""
TITLES = {
    "beam": "beam: falls under its weight",
    "twist": "twist: ends turned against each other",
    "slope": "slope: slides against friction",
    "drop": "drop: falls, rolls and bounces",
    "creature": "creature: a wave of its muscles makes it crawl",
}
STACKED = ("twist", "creature")
"""Scenes whose moments are drawn one below the other."""
FRAMES_PER_SECOND, MOST_FRAMES = 20.0, 100


class SimulatedMotion(NamedTuple):
    """A motion of T steps; t, x and v include the start."""

    t: np.ndarray
    x: np.ndarray
    v: np.ndarray
    info: Info
    compile_seconds: float
    steps_per_second: float
    overlaps: np.ndarray | None = None
    """Pairs of components that overlap after each step [T]; `None` for one component, and with contact."""

    @property
    def finite(self) -> int:
        """Number of moments before the first that is not finite."""
        bad = ~np.isfinite(self.x + self.v).all(axis=(1, 2))
        return int(np.argmax(bad)) if bad.any() else len(bad)

    @property
    def stride(self) -> int:
        """Steps per frame of the GIF, and per file for ParaView."""
        return max(round(1 / (FRAMES_PER_SECOND * self.t[1])), math.ceil(self.finite / MOST_FRAMES), 1)


def run_motion(prepared: PreparedScene, precision: Any) -> SimulatedMotion:
    """Runs the motion in chunks of one compiled program; times compilation separately and waits for the results."""
    _, example, (init, step), dt, steps, _ = prepared
    count = max(1, steps // CHUNKS)
    params = example.scene.params
    start = state = in_precision(init(v=example.v), precision)
    at = functools.partial(inputs, example, dt, count)

    def advance(state: State, params: Params, driven: Any) -> tuple[State, Any]:
        return rollout(
            lambda state, now: step(params, state, *now),
            state,
            driven,
            steps=count,
            observe=lambda state, info: (state.x, state.v, info),
        )

    with progress(steps) as show:
        began = time.perf_counter()
        program = jax.jit(advance).lower(state, params, at()).compile()
        compiled = time.perf_counter() - began
        seen, spent, done = [], 0.0, 0
        while done < steps:
            driven = at(first=done)
            began = time.perf_counter()
            state, chunk = jax.block_until_ready(program(state, params, driven))
            spent += time.perf_counter() - began
            done += count
            seen.append(jax.tree.map(np.asarray, chunk))
            show(min(done, steps), f"t = {min(done, steps) * dt:.2f} s")
    x, v, info = jax.tree.map(lambda *chunks: np.concatenate(chunks)[:steps], *seen)
    x, v = (np.concatenate([np.asarray(first)[None], rest]) for first, rest in ((start.x, x), (start.v, v)))
    overlapping = None if example.scene.contacts else count_overlaps(example.scene.mesh)
    overlaps = None if overlapping is None else np.array([overlapping(at) for at in x[1:]])
    return SimulatedMotion(dt * np.arange(steps + 1), x, v, info, compiled, done / spent, overlaps)


def results(scene: str, mesh: Mesh, motion: SimulatedMotion) -> list[Row]:
    """Rows of report.json."""
    info, iterations = motion.info, motion.info.iterations
    ratios = [volume_ratios(x.astype(np.float64), mesh.vertices, mesh.nodes).min() for x in motion.x]
    rows: dict[str, Any] = {
        "steps_per_second": (motion.steps_per_second, "1/s"),
        "compile_seconds": (motion.compile_seconds, "s"),
        "newton_iterations_mean": (iterations.mean(), "1"),
        "newton_iterations_max": (iterations.max(), "1"),
        "worst_residual_m_per_s2": (info.residual.max(), "m/s²"),
        "steps": (len(info.converged), "1"),
        "steps_not_converged": ((~info.converged).sum(), "1"),
        "smallest_volume_ratio": (np.min(ratios), "1"),
        "energy_created_J": (np.sum(np.asarray(info.energy_growth)), "J"),
    }
    if motion.overlaps is not None:
        rows["overlapping_components_max"] = motion.overlaps.max(), "1"
    if info.least_distance is not None:
        rows["least_distance_of_surfaces"] = info.least_distance.min(), "m"
    bounds = {"steps_not_converged": 0.0}
    return [Row(scene, name, float(value), unit, bound=bounds.get(name)) for name, (value, unit) in rows.items()]


LABELS = {
    "newton_iterations_m": "Newton iterations, m",
    "worst_residual_m_per_s2": "largest residual",
    "smallest_volume_ratio": "smallest volume ratio J",
    "energy_created_J": "energy created by the time step (negative: damped)",
}
"""Words for parts of the quantities' names."""


def warnings(motion: SimulatedMotion) -> list[str]:
    """Warnings about steps that failed, overlapping components and non-finite motions."""
    info, steps, lines = motion.info, len(motion.t) - 1, []
    diverged = np.asarray(info.diverged)
    inverted = np.zeros_like(diverged) if info.least_J is None else ~(np.asarray(info.least_J) > 0)
    unbalanced = ~np.asarray(info.converged) & ~diverged & ~inverted
    reasons = (
        (unbalanced, "did not converge", "try a shorter --dt"),
        (diverged, "diverged: they created energy", "try a shorter --dt or another --integrator"),
        (inverted, "turned elements inside out", "try a shorter --dt, a stiffer material or a slower motion"),
    )
    for missed, what, remedy in reasons:
        if missed.any():
            first = motion.t[np.argmax(missed) + 1]
            lines.append(
                f"warning: {missed.sum()} of {steps} steps {what}, the first at t = {first:.4g} s: "
                f"do not trust the motion from there on; {remedy}"
            )
    if motion.overlaps is not None and (meeting := motion.overlaps > 0).any():
        first = motion.t[np.argmax(meeting) + 1]
        lines.append(
            f"warning: components overlap in {meeting.sum()} of {steps} steps (up to {motion.overlaps.max()} pairs), "
            f"first at t = {first:.4g} s: there is no contact between bodies, and they pass through each other"
        )
    if motion.finite < len(motion.t):
        moment = motion.t[motion.finite]
        lines.append(f"warning: the motion is not finite from t = {moment:.4g} s on; pictures end before")
    return lines


def moments_of(scene: str, example: Example, motion: SimulatedMotion) -> Moments:
    """The scene's selected moments, or start, middle and end if the motion is too short for them."""
    t, stacked = motion.t[: motion.finite], scene in STACKED
    # Bodies in space hide each other in the figure, so fewer moments are drawn.
    every = 1 if stacked or example.scene.mesh.dimension == 2 else 2
    within = [moment for moment in example.moments[::every] if moment <= t[-1] + 1e-9]
    times = within if len(within) > 1 else [0.0, t[-1] / 2, t[-1]]
    chosen = np.unique(np.abs(t[:, None] - np.array(times)).argmin(axis=0))
    return Moments(TITLES[scene], example.scene.mesh, motion.x[chosen], t[chosen], example.ground, stacked=stacked)


def figures_of(
    scene: str, example: Example, motion: SimulatedMotion, picture: Moments, title: str
) -> dict[str, Callable[[Path], None]]:
    """Functions that draw the energies, the moments and the GIF, up to the first moment that is not finite."""
    shown = slice(motion.finite)
    t, x, v, params = motion.t[shown], motion.x[shown], motion.v[shown], example.scene.params
    control, _ = inputs(example, float(t[1]), max(len(t) - 1, 1))
    if control is not None:
        # The start is shown with the actuation of the first step.
        control = jnp.concatenate([control[:1], control])[shown]

    def energies(path: Path) -> None:
        rubs = any(getattr(term, "friction", None) is not None for term in params.terms.values())
        taken = "taken by friction\nand by the time step" if rubs else "taken by the time step"
        if example.control is not None or example.held_path is not None:
            taken = None  # energy is fed in
        stored = motion_energies(example.scene, params, jnp.asarray(x), jnp.asarray(v), control)
        write_figure(path, energies_against_time(t, stored, taken=taken, title=title))

    def film(path: Path) -> None:
        figure, show = soft_body_drawing(
            example.scene.mesh,
            x,
            muscles=example.muscles,
            actuation=None if control is None else np.asarray(control),
            ground=None if example.ground is None else 0.0,
            slope=example.ground or 0.0,
        )
        rate = max(1 / (motion.stride * float(t[1])), 1.0)
        write_gif(path, figure, show, t, frames=range(0, len(t), motion.stride), frames_per_second=rate, title=scene)

    return {"energy.png": energies, "moments.png": png(moments_figure, [picture], columns=1), "motion.gif": film}
