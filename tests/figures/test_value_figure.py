"""The figure of a value closes the circle and shows its arguments."""

import numpy as np

from scripts.reports.figures.values import value_figure


def test_panels_of_a_value():
    axes = np.linspace(-np.pi, np.pi, 12, endpoint=False), np.linspace(-8, 8, 9)
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    V = 1 - np.cos(nodes[..., 0]) + 0.1 * nodes[..., 1] ** 2
    paths = np.stack([np.linspace([3.0, 0.0], [2 * np.pi, 0.0], 20)])
    figure = value_figure(nodes, (1.01 * V, V), (nodes[..., 1] / 4, nodes[..., 1] / 4), paths, limit=2.5, seconds=5.0)
    panels = [axis for axis in figure.axes if axis.get_title()]
    assert [axis.get_title() for axis in panels][:2] == ["fitted value", "value on a grid"]
    assert "1.0e-02" in panels[4].get_title() and panels[0].get_xlim()[1] == np.pi
    figure.draw_without_rendering()
