"""Figures of a log: spectra with the cut-off, the delay of torques, and torque against velocity."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dln_jax.data.checks.report import Examination
from dln_jax.data.encoders.filters import Choice
from dln_jax.figures import style

MOST_JOINTS = 9
"""Largest number of joints whose friction is shown."""
COLUMNS = 3
MOST_POINTS = 3000
"""Largest number of points per joint."""


def log_figure(examined: Examination) -> Figure:
    """One page: spectra and cut-off, time steps or delay, and friction against velocity for every joint."""
    data, smoothed, torques = examined.data, examined.smoothed, examined.torques
    joints = 0 if torques is None or smoothed is None else min(data.degrees_of_freedom, MOST_JOINTS)
    rows = 1 + -(-joints // COLUMNS)
    figure, axes = style.figure(rows, COLUMNS, height=2.3 * rows + 0.3)
    if smoothed is not None and smoothed.choice is not None:
        _filter(axes[0, 0], axes[0, 1], smoothed.choice)
    else:
        for axis in axes[0, :2]:
            axis.set_axis_off()
    for axis in axes[1:].flat[joints:]:
        axis.set_axis_off()
    right = axes[0, 2]
    if torques is None or smoothed is None:
        steps = np.diff(data.t)[np.diff(data.trajectory) == 0]
        right.plot(1e3 * steps, ".", color=style.BLUE, markersize=1.5)
        right.set(xlabel="sample", ylabel="time step, ms")
        return figure
    right.plot(1e3 / smoothed.rate * torques.tried, np.maximum(torques.loss, -1.0), color=style.BLUE, linewidth=1.2)
    right.set_yscale("symlog", linthresh=10.0)
    right.axvline(0.0, color="0.7", linewidth=0.8)
    right.set(xlabel="delay of the torques, ms", ylabel="log likelihood ratio,\nnone / delay")
    for joint, axis in enumerate(axes[1:].flat[:joints]):
        qd, rest = smoothed.data.qd[torques.repaired.log.rows, joint], torques.rest[:, joint]
        every = -(-len(qd) // MOST_POINTS)
        axis.plot(qd[::every], rest[::every], ".", color="0.6", markersize=1.5)
        speeds = np.linspace(qd.min(), qd.max(), 200)
        dry = torques.coulomb[joint] * np.tanh(speeds / torques.velocity_scale[joint])
        friction = torques.viscous[joint] * speeds + dry + float(np.mean(rest))
        axis.plot(speeds, friction, color=style.VERMILLION, linewidth=1.3)
        style.title(axis, f"joint {joint + 1}: {torques.explained[joint]:.0%} explained")
        axis.set_xlabel("velocity, 1/s")
        if joint % COLUMNS == 0:
            axis.set_ylabel("friction and error, N m")
    return figure


def _filter(spectra: Axes, expected: Axes, choice: Choice) -> None:
    """Draws the spectra of q, and the error of qdd that a cut-off is expected to leave."""
    for joint, (spectrum, floor) in enumerate(zip(choice.spectrum.T, choice.floor, strict=True)):
        shade = style.CYCLE[joint % len(style.CYCLE)]
        spectra.loglog(choice.f, spectrum, color=shade, linewidth=0.8, label=f"{joint + 1}")
        if floor > 0:
            spectra.axhline(floor, color=shade, linewidth=0.6, linestyle=":")
    expected.loglog(choice.tried, np.sqrt(np.maximum(choice.error, 1e-16)), color="black", linewidth=1.2)
    if np.isfinite(choice.cutoff):
        for axis in (spectra, expected):
            axis.axvline(choice.cutoff, color=style.VERMILLION, linewidth=1.0)
        style.title(expected, f"{choice.cutoff:.3g} Hz", color=style.VERMILLION)
    spectra.set(xlabel="frequency, Hz", ylabel="spectrum of q, rad²/Hz")
    expected.set(xlabel="cut-off, Hz", ylabel="expected error of qdd")
    style.legend(spectra, ncols=2, handlelength=0.8, columnspacing=0.8, loc="lower left", fontsize=6.5)
