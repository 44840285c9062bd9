"""Figures of an identified robot: torques of each joint with their errors, and friction against velocity."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from dln_jax.data.schema import Trajectories
from dln_jax.figures import style

MOST_SAMPLES = 4000
"""That are drawn."""


def torque_by_joint(
    data: Trajectories, predicted: Float[np.ndarray, "N d"], names: Sequence[str], units: Sequence[str]
) -> Figure:
    """Measured and predicted torque and the residual, a row for each joint, over the first motion of the data.

    Args:
        data: held out.
        predicted: torque of each sample.
        names: of the joints.
        units: of their forces, "N m" or "N".
    """
    shown = np.flatnonzero(data.trajectory == data.trajectory[0])[:MOST_SAMPLES]
    t = data.t[shown]
    d = len(names)
    figure, axes = style.figure(d, 1, height=0.6 + 1.1 * d, sharex=True)
    for joint, axis in enumerate(axes[:, 0]):
        measured, found = data.tau[shown, joint], predicted[shown, joint]
        axis.plot(t, measured, color="black", linewidth=1.6, label="measured")
        axis.plot(t, found, color=style.BLUE, linewidth=1.0, label="identified")
        axis.plot(t, measured - found, color=style.VERMILLION, linewidth=0.8, label="residual")
        style.title(axis, names[joint], loc="left", pad=2, fontsize=style.SMALL)
        axis.set_ylabel(units[joint], fontsize=style.SMALL)
        axis.margins(x=0.01)
    axes[-1, 0].set_xlabel(f"time, s (held out: {data.label[data.trajectory[0]]})")
    figure.align_ylabels(axes[:, 0])
    style.legend(figure, *axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def friction_curves(
    qd: Float[np.ndarray, "N d"],
    left: Float[np.ndarray, "N d"],
    curve_rates: Float[np.ndarray, "K d"],
    curves: Float[np.ndarray, "K d"],
    names: Sequence[str],
    units: Sequence[str],
) -> Figure:
    """Friction against velocity, a panel for each joint: data less the bodies' torque, and the identified law.

    Args:
        qd: velocities of samples.
        left: measured torque less that of the bodies.
        curve_rates: velocities of the law.
        curves: its force.
        names: of the joints.
        units: of their forces, "N m" or "N".
    """
    d = len(names)
    columns = min(d, 3)
    rows = -(-d // columns)
    figure, axes = style.figure(rows, columns, height=0.5 + 1.9 * rows)
    step = -(-len(qd) // MOST_SAMPLES)
    for joint, axis in enumerate(axes.flat):
        if joint >= d:
            axis.set_visible(False)
            continue
        data = axis.plot(qd[::step, joint], left[::step, joint], ".", color="0.6", markersize=2, label="measured")
        data[0].set_rasterized(True)
        axis.plot(curve_rates[:, joint], curves[:, joint], color=style.BLUE, linewidth=1.6, label="identified")
        low, high = np.percentile(left[:, joint], [0.5, 99.5])
        low, high = min(low, curves[:, joint].min()), max(high, curves[:, joint].max())
        room = 0.1 * (high - low) or 1.0
        axis.set_ylim(low - room, high + room)
        style.title(axis, f"{names[joint]:.24}")
        axis.set_ylabel(f"friction, {units[joint]}", fontsize=style.SMALL)
        axis.set_xlabel("velocity, " + ("rad/s" if units[joint] == "N m" else "m/s"), fontsize=style.SMALL)
    style.legend(figure, *axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure
