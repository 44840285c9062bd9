"""Speed-ups by shared work: measured on one machine, and modelled for many hosts."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dln_jax.figures import style

DASHES = ("-", "--", ":")


def speed_ups(
    measured: Mapping[str, Mapping[str, float]],
    modelled: Mapping[str, Mapping[str, Sequence[float]]],
    *,
    hosts: Sequence[int],
    x: str,
) -> Figure:
    """Speed-ups over one device.

    Args:
        measured: speed-ups by work and layout, drawn as bars.
        modelled: speed-ups by work and network, one per number of hosts, drawn as lines beside the ideal one.
        hosts: numbers of hosts.
        x: label of the bars' axis, which names the works.
    """
    figure, [[bars, lines]] = style.figure(1, 2, height=3.6)
    _draw_bars(bars, measured)
    bars.set(xlabel=x, ylabel="times as fast as one device")
    style.title(bars, "measured on this machine")
    lines.plot(hosts, hosts, color=style.REFERENCE, linewidth=1.0, label="ideal")
    colours = style.colours_of(modelled)
    for work, networks in modelled.items():
        for dash, (network, values) in zip(DASHES, networks.items(), strict=False):
            label = f"{work}, {network.replace('_gbit', ' Gbit/s')}"
            lines.plot(hosts, values, dash, color=colours[work], marker="o", markersize=3, linewidth=1.4, label=label)
    lines.set_xscale("log", base=2)
    lines.set_yscale("log", base=2)
    for axis in (lines.xaxis, lines.yaxis):
        axis.set_major_formatter("{x:g}")
    lines.set(xlabel="hosts", ylabel="times as fast as one")
    style.title(lines, "modelled, not measured")
    style.legend(figure, *lines.get_legend_handles_labels(), loc="outside lower right", ncols=3)
    return figure


def _draw_bars(axis: Axes, measured: Mapping[str, Mapping[str, float]]) -> None:
    places = np.arange(len(measured))
    names = list(dict.fromkeys(name for layouts in measured.values() for name in layouts))
    colours, width = style.colours_of(names), 0.8 / max(len(names), 1)
    for number, name in enumerate(names):
        heights = [layouts.get(name, np.nan) for layouts in measured.values()]
        at = places + (number - (len(names) - 1) / 2) * width
        axis.bar(at, heights, 0.9 * width, color=colours[name], label=name.replace("-", " "))
    axis.axhline(1.0, color="0.6", linewidth=0.8, linestyle="--")
    axis.set_xticks(places, list(measured))
    axis.set_ylim(top=1.35 * max([1.0, *(value for layouts in measured.values() for value in layouts.values())]))
    style.legend(axis, loc="upper center", ncols=2)
