"""Figures of motions in phase space: paths and energies of the truth, a baseline and a Hamiltonian model."""

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from dln_jax.metrics.phase_space import Motions

TRUTH = "truth"
COLOURS = {
    TRUTH: "#111111",
    "baseline": "#2e6f95",
    "hnn": "#d1495b",
    "black-box-hnn": "#e8a33d",
    "polynomial": "#5b8e3e",
}

Field = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""(q [N, 1], p [N, 1]) -> (qd, pd)."""


def motion_figure(
    motions: Mapping[str, Motions],
    energies: Mapping[str, Float[np.ndarray, "K T"]],
    *,
    fields: Mapping[str, Field] | None = None,
    quantity: str = "energy",
    shown: int = 0,
) -> Figure:
    """One motion as each system has it, a panel each, and its energy (or another `quantity`) against time.

    With one coordinate a panel is the phase plane, with arrows where `fields` give the rates; with 2 n coordinates it
    shows the orbits of n bodies in a plane.

    Args:
        motions: by name; "truth" is drawn behind each of the others.
        energies: the true energy, or the other quantity, along them.
        fields: rates of the systems, one coordinate only.
        shown: which motion.
    """
    figure = Figure(figsize=(3.1 * len(motions) + 4.2, 3.4), layout="constrained", dpi=130)
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(motions) + 1, width_ratios=[3.0] * len(motions) + [4.0])
    truth = plane_paths(motions[TRUTH], shown)
    plane = motions[TRUTH].q.shape[2] == 1
    corner = 1.25 * max(float(np.abs(path).max()) for path in truth)
    for axis, (name, moved) in zip(axes, motions.items(), strict=False):
        for x, y in truth:
            axis.plot(x, y, color=COLOURS[TRUTH], linewidth=1.0)
        if name != TRUTH:
            for x, y in plane_paths(moved, shown):
                axis.plot(x, y, color=COLOURS.get(name, "C0"), linewidth=1.4)
        if plane and fields is not None and name in fields:
            _arrows(axis, fields[name], corner)
        axis.set(xlim=(-corner, corner), ylim=(-corner, corner), aspect="equal", title=name)
        axis.set_xlabel("q" if plane else "x, m")
        axis.set_ylabel("p" if plane else "y, m")
    t = motions[TRUTH].t
    for name in motions:
        finite = np.where(np.isfinite(energies[name][shown]), energies[name][shown], np.nan)
        style = "--" if name == TRUTH else "-"
        axes[-1].plot(t, finite, style, color=COLOURS.get(name, "C0"), label=name, zorder=3 if name == TRUTH else 2)
    axes[-1].set(xlabel="t, s", ylabel=quantity, title=f"{'true ' * (quantity == 'energy')}{quantity} along each")
    axes[-1].set_ylim(*_limits(energies[TRUTH][shown], [each[shown] for each in energies.values()]))
    axes[-1].grid(True, alpha=0.25)
    axes[-1].legend(frameon=False, fontsize=8)
    return figure


def _limits(truth: np.ndarray, curves: list[np.ndarray]) -> tuple[float, float]:
    """Room for the truth and for most of what the others do; one that runs away leaves the picture."""
    every = np.concatenate([each[np.isfinite(each)] for each in curves])
    low, high = np.quantile(every, [0.03, 0.97])
    low, high = min(low, truth.min()), max(high, truth.max())
    margin = 0.1 * max(high - low, 0.05 * float(np.abs(truth).max()))
    return float(low - margin), float(high + margin)


def plane_paths(motions: Motions, shown: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Curves of one motion: (q, p), or (x, y) of each body; gaps where it is not finite."""
    q, p = motions.q[shown], motions.p[shown]
    q, p = (np.where(np.isfinite(each), each, np.nan) for each in (q, p))
    if q.shape[1] == 1:
        return [(q[:, 0], p[:, 0])]
    return [(q[:, 2 * body], q[:, 2 * body + 1]) for body in range(q.shape[1] // 2)]


def _arrows(axis, field: Field, corner: float) -> None:
    grid = np.linspace(-corner, corner, 11)
    q, p = (each.reshape(-1, 1) for each in np.meshgrid(grid, grid))
    qd, pd = field(q, p)
    axis.quiver(q, p, qd, pd, color="0.7", zorder=0, width=4e-3)
