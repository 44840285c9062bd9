"""Figures of soft-body cases; all functions return a Matplotlib figure."""

from collections.abc import Callable

import numpy as np
from matplotlib.figure import Figure

from dln_jax.figures import style
from dln_jax.figures.soft_bodies import Moments, moments_figure
from scripts.reports.figures.costs import cost_curves
from scripts.reports.figures.labels import label_ends
from scripts.reports.soft_bodies.motions import DT
from scripts.reports.soft_bodies.statics import ELASTICA

LEAST_SHARE = 0.1
"""Minimum range of the energy axis above and below the initial energy, relative to it."""


def orders(curves: dict) -> Figure:
    """Error of a swing against the time step."""
    lines = {name: (curves["dt"], errors) for name, errors in curves.items() if name != "dt"}
    return cost_curves(lines, x="time step, s", y="largest error after 1 s, m", title="")


def energies(curves: dict) -> Figure:
    """Change of the energy of a free body over time, relative to the first."""
    figure, [[axis]] = style.figure(height=3.4)
    colours = style.colours_of(curves)
    ends = {}
    for name, energy in curves.items():
        t, percent = DT * np.arange(len(energy)), 100.0 * (np.asarray(energy) - 1.0)
        axis.plot(t, percent, color=colours[name])
        ends[name] = (float(t[-1]), float(percent[-1]))
    low, high = axis.get_ylim()
    axis.set_ylim(min(low, -100.0 * LEAST_SHARE), max(high, 100.0 * LEAST_SHARE))
    axis.set(xlabel="t, s", ylabel="change of the energy, %")
    label_ends(axis, ends, colours=colours)
    return figure


def elastica(curves: dict) -> Figure:
    """Tip of the elastica against the load, by mesh and extrapolated."""
    figure, [[axis]] = style.figure(height=3.6)
    for number, (cells, tips) in enumerate(zip(curves["cells"], curves["tips"], strict=True), start=1):
        shade = style.CYCLE[number % len(style.CYCLE)]
        axis.plot(
            curves["loads"], tips[:, 0], ".--", color=shade, linewidth=0.8, label=f"{cells} cells over the height"
        )
    axis.plot(curves["loads"], curves["extrapolated"][:, 0], "o-", color=style.BLUE, label="extrapolated")
    closed = [deflection for deflection, _ in ELASTICA.values()]
    axis.plot(list(ELASTICA), closed, "x", color="black", markersize=7, zorder=4, label="closed form")
    axis.set(xlabel="P L²/EI, 1", ylabel="deflection of the tip / L, 1")
    style.legend(axis)
    return figure


def recovery(curves: dict) -> Figure:
    """Smallest J over all elements while a mesh recovers."""
    figure, [[axis]] = style.figure(height=3.4)
    colours = style.colours_of(curves)
    for name, least in curves.items():
        axis.plot(np.arange(1, len(least) + 1), least, color=colours[name])
    axis.axhline(0.0, color=style.REFERENCE, linestyle=":")
    axis.set_yscale("symlog", linthresh=1.0)
    axis.set(xlabel="steps", ylabel="least J = det F, 1")
    label_ends(axis, {name: (float(len(least)), float(least[-1])) for name, least in curves.items()}, colours=colours)
    return figure


def twisted_bar(curves: dict) -> Figure:
    """The bar at a few moments of its twist."""
    title = f"twisted by up to {curves['turns'][-1]:g} turns"
    return moments_figure([Moments(title, curves["mesh"], curves["x"], curves["t"], stacked=True)], columns=1)


def differences(curves: dict) -> Figure:
    """Difference of gradient and finite differences against their step."""
    figure, [[axis]] = style.figure(height=3.8)
    steps = curves["relative_steps"]
    for number, (name, errors) in enumerate(curves["errors"].items()):
        again, place = divmod(number, len(style.CYCLE))
        (line,) = axis.loglog(steps, np.maximum(errors, 1e-16), ".-", color=style.CYCLE[place], linewidth=0.8)
        line.set(label=name, linestyle="--" if again else "-")
    axis.axhline(1e-7, color=style.REFERENCE, linestyle=":")
    axis.set(xlabel="step, relative to the quantity", ylabel="|difference quotient / gradient - 1|")
    style.legend(figure, loc="outside lower center", ncols=4)
    return figure


def solver_times(curves: dict) -> Figure:
    """Time per factor-and-solve against the number of unknowns."""
    return cost_curves(curves, x="unknowns", y="s per factor-and-solve", title="")


def speed_against_error(curves: dict) -> Figure:
    """Error against the time that a simulated second takes."""
    lines = {name: (1 / (each[1] * curves["dt"]), each[0]) for name, each in curves.items() if name != "dt"}
    return cost_curves(lines, x="s of computing per simulated s", y="largest error / largest motion", title="")


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
"""Functions that draw a measurement's curves, by name."""
