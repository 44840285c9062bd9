"""Figures of the hard cases where a picture says more; each returns a Matplotlib figure."""

from collections.abc import Callable

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure


def curvature(curves: dict) -> Figure:
    """Relative error of tanh'' in float32."""
    figure, axis = _figure()
    for name, errors in curves["errors"].items():
        axis.loglog(curves["x"], np.clip(errors, 1e-9, 1e3), label=name)
    axis.axhline(float(np.finfo(np.float32).eps), color="0.6", linestyle=":", label="rounding unit")
    axis.set(xlabel="x", ylabel="relative error of tanh'' in float32")
    axis.legend(frameon=False, fontsize=8)
    return figure


def energy_errors(curves: dict) -> Figure:
    """Largest energy error so far near the separatrix, with the amplitudes that theory gives."""
    figure, axis = _figure()
    for number, (name, errors) in enumerate(curves["errors"].items()):
        axis.loglog(curves["steps"], np.maximum(errors, 1e-16), color=f"C{number}", label=name)
        if name in curves["references"]:
            axis.axhline(curves["references"][name], color=f"C{number}", linestyle=":", linewidth=1)
    axis.set(xlabel="steps of 0.01 s", ylabel="largest |E - E(0)| so far, J", title="dotted: predicted amplitude")
    axis.set_ylim(1e-13, 1e4)
    axis.legend(frameon=False, fontsize=8, loc="lower right", ncols=2)
    return figure


def divergence(curves: dict) -> Figure:
    """How a chaotic motion and its rewritten twin part, beside exp(lambda t)."""
    figure, axis = _figure()
    t, exponents = curves["t"], curves["exponents"]
    shown = t <= 80 / exponents.min()
    for k, exponent in enumerate(exponents):
        axis.semilogy(t[shown], np.maximum(curves["rounding"][shown, k], 1e-17), color=f"C{k}", linewidth=0.9)
        growth = np.minimum(np.finfo(float).eps * np.exp(exponent * t[shown]), 10)
        label = f"eps exp(λt), λ = {exponent:.2f}/s"
        axis.semilogy(t[shown], growth, color=f"C{k}", linestyle="--", linewidth=1, label=label)
    axis.axhline(1.0, color="0.6", linestyle=":")
    axis.set(xlabel="t, s", ylabel="difference of angles, rad", title="two ways to write one double pendulum")
    axis.legend(frameon=False, fontsize=8, loc="lower right")
    return figure


def noise_sweep(curves: dict) -> Figure:
    """Error of a linear fit against the noise, measured and predicted."""
    figure, axis = _figure()
    for number, name in enumerate(("torque", "acceleration")):
        measured, predicted = curves[name]
        axis.loglog(curves["levels"], measured, "o", color=f"C{number}", label=f"noise on {name}")
        axis.loglog(curves["levels"], predicted, "--", color=f"C{number}", label="predicted")
    axis.set(xlabel="noise, in standard deviations of the quantity", ylabel="torque MSE, (N m)²")
    axis.legend(frameon=False, fontsize=8)
    return figure


FIGURES: dict[str, Callable[[dict], Figure]] = {
    "activations": curvature,
    "separatrix": energy_errors,
    "lyapunov-time": divergence,
    "noise": noise_sweep,
}
"""By the name of the hard case."""


def _figure():
    figure = Figure(figsize=(7.0, 4.4), layout="constrained", dpi=130)
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    axis.grid(True, which="major", alpha=0.25)
    return figure, axis
