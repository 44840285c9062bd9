"""Figures of the hard cases; all functions return a Matplotlib figure."""

from collections.abc import Callable

import numpy as np
from matplotlib.figure import Figure

from dln_jax.figures import style
from scripts.reports.figures.labels import label_ends


def curvature(curves: dict) -> Figure:
    """Relative error of tanh'' in float32."""
    figure, [[axis]] = style.figure(height=3.6)
    colours = style.colours_of(curves["errors"])
    shown = {name: np.clip(errors, 1e-9, 1e3) for name, errors in curves["errors"].items()}
    for name, errors in shown.items():
        axis.loglog(curves["x"], errors, color=colours[name])
    unit = float(np.finfo(np.float32).eps)
    axis.axhline(unit, color=style.REFERENCE, linestyle=":")
    axis.set(xlabel="x, 1", ylabel="relative error of tanh'' in float32, 1")
    ends = {name: (float(curves["x"][-1]), float(errors[-1])) for name, errors in shown.items()}
    ends["rounding unit"] = (float(curves["x"][-1]), unit)
    label_ends(axis, ends, colours={**colours, "rounding unit": style.REFERENCE})
    return figure


def energy_errors(curves: dict) -> Figure:
    """Largest energy error so far near the separatrix, with the amplitudes that theory gives."""
    figure, [[axis]] = style.figure(height=4.0)
    colours = style.colours_of(curves["errors"])
    ends = {}
    for name, errors in curves["errors"].items():
        shown = np.maximum(errors, 1e-16)
        axis.loglog(curves["steps"], shown, color=colours[name])
        ends[name] = (float(curves["steps"][-1]), float(shown[-1]))
        if name in curves["references"]:
            axis.axhline(curves["references"][name], color=colours[name], linestyle=":", linewidth=1)
    axis.set(xlabel="steps of 0.01 s", ylabel="largest |E - E(0)| so far, J", ylim=(1e-13, 1e4))
    style.title(axis, "near the separatrix; dotted: predicted amplitude")
    label_ends(axis, ends, colours=colours)
    return figure


def divergence(curves: dict) -> Figure:
    """Divergence of a chaotic motion and its rewritten twin, beside exp(lambda t)."""
    figure, [[axis]] = style.figure(height=3.6)
    t, exponents = curves["t"], curves["exponents"]
    shown = t <= 80 / exponents.min()
    for k, exponent in enumerate(exponents):
        colour = style.CYCLE[k % len(style.CYCLE)]
        axis.semilogy(t[shown], np.maximum(curves["rounding"][shown, k], 1e-17), color=colour, linewidth=0.9)
        growth = np.minimum(np.finfo(float).eps * np.exp(exponent * t[shown]), 10)
        label = f"eps exp(λt), λ = {exponent:.2f}/s"
        axis.semilogy(t[shown], growth, color=colour, linestyle="--", linewidth=1, label=label)
    axis.axhline(1.0, color=style.REFERENCE, linestyle=":")
    axis.set(xlabel="t, s", ylabel="difference of angles, rad")
    style.title(axis, "two ways to write one double pendulum")
    style.legend(axis, loc="lower right")
    return figure


def noise_sweep(curves: dict) -> Figure:
    """Error of a linear fit against the noise, measured and predicted."""
    figure, [[axis]] = style.figure(height=3.6)
    for name, colour in (("torque", style.BLUE), ("acceleration", style.VERMILLION)):
        measured, predicted = curves[name]
        axis.loglog(curves["levels"], measured, "o", color=colour, markersize=5, label=f"noise on {name}")
        axis.loglog(curves["levels"], predicted, "--", color=colour, label="predicted")
    axis.set(xlabel="noise, in standard deviations of the quantity", ylabel="torque MSE, (N m)²")
    style.legend(axis)
    return figure


FIGURES: dict[str, Callable[[dict], Figure]] = {
    "activations": curvature,
    "separatrix": energy_errors,
    "lyapunov-time": divergence,
    "noise": noise_sweep,
}
"""Functions that draw a hard case's curves, by name."""
