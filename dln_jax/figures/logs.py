"""Figures of a log: spectra with the cut-off, the delay of torques, and torque against velocity."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dln_jax.data.checks.report import Examination
from dln_jax.data.checks.torques import Torques
from dln_jax.data.encoders.filters import Choice
from dln_jax.data.schema import Trajectories
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
        _spectra(axes[0, 0], smoothed.choice)
        _expected(axes[0, 1], smoothed.choice)
    else:
        axes[0, 0].set_axis_off()
        axes[0, 1].set_axis_off()
    for axis in axes[1:].flat[joints:]:
        axis.set_axis_off()
    if torques is None or smoothed is None:
        _steps(axes[0, 2], data)
        return figure
    _delays(axes[0, 2], torques, smoothed.rate)
    for joint, axis in enumerate(axes[1:].flat[:joints]):
        _friction(axis, torques, smoothed.data.qd[torques.repaired.log.rows, joint], joint)
        if joint % COLUMNS == 0:
            axis.set_ylabel("friction and error, N m")
    return figure


def _friction(axis: Axes, torques: Torques, qd: np.ndarray, joint: int) -> None:
    shown = slice(None, None, -(-len(qd) // MOST_POINTS))
    axis.plot(qd[shown], torques.rest[shown, joint], ".", color="0.6", markersize=1.5)
    speeds = np.linspace(qd.min(), qd.max(), 200)
    dry = torques.coulomb[joint] * np.tanh(speeds / torques.velocity_scale[joint])
    offset = float(np.mean(torques.rest[:, joint]))
    axis.plot(speeds, torques.viscous[joint] * speeds + dry + offset, color=style.VERMILLION, linewidth=1.3)
    style.title(axis, f"joint {joint + 1}: {torques.explained[joint]:.0%} explained")
    axis.set_xlabel("velocity, 1/s")


def _spectra(axis: Axes, choice: Choice) -> None:
    for joint, shade in zip(range(choice.spectrum.shape[1]), [*style.CYCLE, *style.CYCLE], strict=False):
        axis.loglog(choice.f, choice.spectrum[:, joint], color=shade, linewidth=0.8, label=f"{joint + 1}")
        if choice.floor[joint] > 0:
            axis.axhline(choice.floor[joint], color=shade, linewidth=0.6, linestyle=":")
    if np.isfinite(choice.cutoff):
        axis.axvline(choice.cutoff, color=style.VERMILLION, linewidth=1.0)
    axis.set_xlabel("frequency, Hz")
    axis.set_ylabel("spectrum of q, rad²/Hz")
    style.legend(axis, ncols=2, handlelength=0.8, columnspacing=0.8, loc="lower left", fontsize=6.5)


def _expected(axis: Axes, choice: Choice) -> None:
    axis.loglog(choice.tried, np.sqrt(np.maximum(choice.error, 1e-16)), color="black", linewidth=1.2)
    if np.isfinite(choice.cutoff):
        axis.axvline(choice.cutoff, color=style.VERMILLION, linewidth=1.0)
        axis.annotate(
            f" {choice.cutoff:.3g} Hz", (choice.cutoff, 0.95), xycoords=("data", "axes fraction"),
            color=style.VERMILLION, fontsize=style.SMALL, va="top",
        )  # fmt: skip
    axis.set_xlabel("cut-off, Hz")
    axis.set_ylabel("expected error of qdd")


def _delays(axis: Axes, torques: Torques, rate: float) -> None:
    axis.plot(1e3 / rate * torques.tried, np.maximum(torques.loss, -1.0), color=style.BLUE, linewidth=1.2)
    axis.set_yscale("symlog", linthresh=10.0)
    axis.axvline(0.0, color="0.7", linewidth=0.8)
    axis.set_xlabel("delay of the torques, ms")
    axis.set_ylabel("log likelihood ratio,\nnone / delay")


def _steps(axis: Axes, data: Trajectories) -> None:
    steps = np.diff(data.t)[np.diff(data.trajectory) == 0]
    axis.plot(1e3 * steps, ".", color=style.BLUE, markersize=1.5)
    axis.set_xlabel("sample")
    axis.set_ylabel("time step, ms")
