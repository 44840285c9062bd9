"""Figures of the cases of soft bodies where a picture says more; each returns a Matplotlib figure."""

from collections.abc import Callable

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from dln_jax.figures.soft_bodies import Moments, moments_figure
from dln_jax.studies.soft_bodies.motions import DT
from dln_jax.studies.soft_bodies.statics import ELASTICA


def orders(curves: dict) -> Figure:
    """Error of a swing against the time step."""
    figure, axis = _figure()
    dt = curves["dt"]
    for name, errors in curves.items():
        if name != "dt":
            axis.loglog(dt, errors, "o-", label=name)
    axis.set(xlabel="time step, s", ylabel="largest error after 1 s, m")
    axis.legend(frameon=False, fontsize=8)
    return figure


def energies(curves: dict) -> Figure:
    """Energy of a free body over time."""
    figure, axis = _figure()
    for name, energy in curves.items():
        axis.plot(DT * np.arange(len(energy)), energy, label=name)
    axis.set(xlabel="t, s", ylabel="energy / first energy")
    axis.legend(frameon=False, fontsize=8)
    return figure


def elastica(curves: dict) -> Figure:
    """Tip of the elastica against the load, for each mesh and extrapolated."""
    figure, axis = _figure()
    for cells, tips in zip(curves["cells"], curves["tips"], strict=True):
        axis.plot(curves["loads"], tips[:, 0], ".--", linewidth=0.8, label=f"{cells} cells over the height")
    axis.plot(curves["loads"], curves["extrapolated"][:, 0], "o-", label="extrapolated")
    axis.plot(list(ELASTICA), [deflection for deflection, _ in ELASTICA.values()], "kx", label="closed form")
    axis.set(xlabel="P L²/EI", ylabel="deflection of the tip / L")
    axis.legend(frameon=False, fontsize=8)
    return figure


def recovery(curves: dict) -> Figure:
    """The least J of all elements while a mesh recovers."""
    figure, axis = _figure()
    for name, least in curves.items():
        axis.plot(np.arange(1, len(least) + 1), least, label=name)
    axis.axhline(0.0, color="0.6", linestyle=":")
    axis.set_yscale("symlog", linthresh=1.0)
    axis.set(xlabel="steps", ylabel="least J = det F")
    axis.legend(frameon=False, fontsize=8)
    return figure


def twisted_bar(curves: dict) -> Figure:
    """The bar at a few moments of its twist."""
    title = f"twisted by up to {curves['turns'][-1]:g} turns"
    return moments_figure([Moments(title, curves["mesh"], curves["x"], curves["t"], stacked=True)], columns=1)


def differences(curves: dict) -> Figure:
    """Difference of gradient and finite differences against their step."""
    figure, axis = _figure()
    for name, errors in curves["errors"].items():
        axis.loglog(curves["relative_steps"], np.maximum(errors, 1e-16), ".-", linewidth=0.8, label=name)
    axis.axhline(1e-7, color="0.6", linestyle=":")
    axis.set(xlabel="step, relative to the quantity", ylabel="|difference quotient / gradient - 1|")
    axis.legend(frameon=False, fontsize=7, ncols=2)
    return figure


def solver_times(curves: dict) -> Figure:
    """Time per factor-and-solve against the number of unknowns."""
    figure, axis = _figure()
    for name, (sizes, times) in curves.items():
        axis.loglog(sizes, times, "o-", label=name)
    axis.set(xlabel="unknowns", ylabel="s per factor-and-solve")
    axis.legend(frameon=False, fontsize=8)
    return figure


def speed_against_error(curves: dict) -> Figure:
    """Error against the time that a simulated second takes."""
    figure, axis = _figure()
    for name, values in curves.items():
        if name != "dt":
            errors, rates = values
            axis.loglog(1 / (rates * curves["dt"]), errors, "o-", label=name)
    axis.set(xlabel="s of computing per simulated s", ylabel="largest error / largest motion")
    axis.legend(frameon=False, fontsize=8)
    return figure


FIGURES: dict[str, Callable[[dict], Figure]] = {
    "orders": orders,
    "invariants": energies,
    "elastica": elastica,
    "bad-starts": recovery,
    "twist": twisted_bar,
    "crawler": differences,
    "coulomb": differences,
    "linear-solvers": solver_times,
    "speed-against-error": speed_against_error,
}
"""By the name of the measurement."""


def _figure():
    figure = Figure(figsize=(7.0, 4.4), layout="constrained", dpi=130)
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    axis.grid(True, which="major", alpha=0.25)
    return figure, axis
