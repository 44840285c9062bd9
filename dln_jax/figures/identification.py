"""Torques of an identified robot, joint by joint, with their errors; `friction` has the friction curves."""

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from dln_jax.data.schema import Trajectories
from dln_jax.figures import style

MOST_SAMPLES = 4000
"""Largest number of samples drawn."""


def torque_by_joint(
    data: Trajectories, predicted: Float[np.ndarray, "N d"], names: Sequence[str], units: Sequence[str]
) -> Figure:
    """Measured and predicted torque and their difference over the first motion, one row per joint.

    Args:
        data: held-out data.
        predicted: predicted torque of every sample.
        names: names of the joints.
        units: units of their forces, "N m" or "N".
    """
    shown = np.flatnonzero(data.trajectory == data.trajectory[0])[:MOST_SAMPLES]
    t = data.t[shown]
    d = len(names)
    figure, axes = style.figure(d, 1, height=0.6 + 1.1 * d, sharex=True)
    for joint, axis in enumerate(axes[:, 0]):
        measured, found = data.tau[shown, joint], predicted[shown, joint]
        axis.plot(t, measured, color="black", linewidth=1.6, label="measured")
        axis.plot(t, found, color=style.BLUE, linewidth=1.0, label="identified")
        axis.plot(t, found - measured, color=style.VERMILLION, linewidth=0.8, label="identified minus measured")
        style.title(axis, names[joint], loc="left", pad=2, fontsize=style.SMALL)
        axis.set_ylabel(units[joint], fontsize=style.SMALL)
        axis.margins(x=0.01)
    axes[-1, 0].set_xlabel(f"time, s (held out: {_in_words(str(data.label[data.trajectory[0]]))})")
    figure.align_ylabels(axes[:, 0])
    style.legend(figure, *axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def _in_words(label: str) -> str:
    """The label of a block of time, as `data.splits` names it, in words; other labels unchanged."""
    block = re.fullmatch(r"(.*)\[(\d+)\]", label)
    return label if block is None else f"block {int(block[2]) + 1} of recording {block[1]}"
