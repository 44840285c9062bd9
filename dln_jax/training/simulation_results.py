"""Output of `simulate` for a motion: metrics, warnings, figures and the GIF."""

import math
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from dln_jax.figures.soft_bodies import Moments, energies_against_time, moments_figure, write_soft_body_gif
from dln_jax.files import write_figure
from dln_jax.metrics.report import Row
from dln_jax.metrics.soft_body_energies import motion_energies
from dln_jax.softbody.driven import Example, drive
from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.mesh.simplices import volume_ratios
from dln_jax.softbody.verdict import Info

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


def results(scene: str, mesh: Mesh, motion: SimulatedMotion) -> list[Row]:
    """Rows of the table."""
    info, iterations = motion.info, motion.info.iterations
    ratios = np.stack([volume_ratios(x.astype(np.float64), mesh.vertices, mesh.nodes) for x in motion.x])
    numbers = (
        ("steps_per_second", motion.steps_per_second, "1/s", None),
        ("compile_seconds", motion.compile_seconds, "s", None),
        ("newton_iterations_mean", float(iterations.mean()), "1", None),
        ("newton_iterations_max", float(iterations.max()), "1", None),
        ("worst_residual_m_per_s2", float(info.residual.max()), "m/s²", None),
        ("steps", float(len(info.converged)), "1", None),
        ("steps_not_converged", float((~info.converged).sum()), "1", 0.0),
        ("smallest_volume_ratio", float(ratios.min()), "1", None),
        ("energy_created_J", float(np.sum(np.asarray(info.energy_growth))), "J", None),
    )
    if info.substeps is not None:
        numbers += (("steps_shortened", float((info.substeps > 1).sum()), "1", None),)
    if info.overlaps is not None:
        numbers += (("overlapping_components_max", float(info.overlaps.max()), "1", None),)
    if info.least_distance is not None:
        numbers += (("least_distance_of_surfaces", float(info.least_distance.min()), "m", None),)
    return [Row(scene, name, value, unit, bound=bound) for name, value, unit, bound in numbers]


LABELS = {
    "worst_residual_m_per_s2": "worst residual",
    "smallest_volume_ratio": "smallest J = volume / rest volume",
    "energy_created_J": "energy created by the time step (damped where negative)",
}
"""Labels of quantities that are not self-explanatory."""


def line(row: Row) -> tuple[str, str, str]:
    """A row as label, value and unit."""
    label = LABELS.get(row.quantity, row.quantity.replace("_", " "))
    return label, f"{row.value:.4g}", "" if row.unit == "1" else row.unit


def warn(motion: SimulatedMotion) -> None:
    """Warns about steps that failed, overlapping components and non-finite motions."""
    info, steps = motion.info, len(motion.t) - 1
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
            print(
                f"warning: {missed.sum()} of {steps} steps {what}, the first at t = {first:.4g} s: "
                f"do not trust the motion from there on; {remedy}"
            )
    if info.overlaps is not None and (meeting := info.overlaps > 0).any():
        first = motion.t[np.argmax(meeting) + 1]
        print(
            f"warning: components overlap in {meeting.sum()} of {steps} steps (up to {info.overlaps.max()} pairs), "
            f"first at t = {first:.4g} s: there is no contact between bodies, and they pass through each other"
        )
    if (finite := finite_moments(motion)) < len(motion.t):
        print(f"warning: the motion is not finite from t = {motion.t[finite]:.4g} s on; pictures end before")


def finite_moments(motion: SimulatedMotion) -> int:
    """Number of moments before the first that is not finite."""
    bad = np.array([not np.isfinite(x + v).all() for x, v in zip(motion.x, motion.v, strict=True)])
    return int(np.argmax(bad)) if bad.any() else len(bad)


def stride(motion: SimulatedMotion) -> int:
    """Steps per frame of the GIF, and per file for ParaView."""
    return max(round(1 / (FRAMES_PER_SECOND * motion.t[1])), math.ceil(finite_moments(motion) / MOST_FRAMES), 1)


def draw(scene: str, example: Example, motion: SimulatedMotion, folder: Path, *, title: str, figures: bool) -> Moments:
    """Writes the figures and the GIF; returns the moments drawn."""
    shown = finite_moments(motion)
    dt = float(motion.t[1])
    t, x, v = motion.t[:shown], motion.x[:shown], motion.v[:shown]
    driven = drive(example, dt, max(shown - 1, 1))
    control = driven.control
    if control is not None:
        # The start is shown with the actuation of the first step.
        control = jnp.concatenate([control[:1], control])[:shown]
    picture = moments(scene, example, t, x)
    if not figures:
        return picture
    energies = motion_energies(example.scene, example.scene.params, jnp.asarray(x), jnp.asarray(v), control)
    figure = energies_against_time(t, energies, taken=what_takes(example), title=title)
    write_figure(folder / "energy.png", figure)
    write_figure(folder / "moments.png", moments_figure([picture], columns=1))
    every = stride(motion)
    write_soft_body_gif(
        folder / "motion.gif",
        example.scene.mesh,
        x,
        t,
        muscles=example.muscles,
        actuation=None if control is None else np.asarray(control),
        ground=None if example.ground is None else 0.0,
        slope=example.ground or 0.0,
        title=scene,
        stride=every,
        frames_per_second=max(1 / (every * dt), 1.0),
    )
    return picture


def what_takes(example: Example) -> str | None:
    """Label of the energy that is dissipated; `None` if energy is fed in."""
    if example.control is not None or example.held_path is not None:
        return None
    rubs = any(getattr(parameters, "friction", None) is not None for parameters in example.scene.params.terms.values())
    return "taken by friction\nand by the time step" if rubs else "taken by the time step"


def moments(scene: str, example: Example, t: np.ndarray, x: np.ndarray) -> Moments:
    """The scene's selected moments, or start, middle and end if the motion is too short for them."""
    # Bodies in space hide each other in the figure, so fewer moments are drawn.
    every = 1 if scene in STACKED or example.scene.mesh.dimension == 2 else 2
    within = [moment for moment in example.moments[::every] if moment <= t[-1] + 1e-9]
    times = within if len(within) > 1 else [0.0, t[-1] / 2, t[-1]]
    chosen = np.unique(np.abs(t[:, None] - np.array(times)).argmin(axis=0))
    return Moments(TITLES[scene], example.scene.mesh, x[chosen], t[chosen], example.ground, stacked=scene in STACKED)
