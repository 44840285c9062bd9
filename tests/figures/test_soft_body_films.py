"""Snapshots of bodies in the plane have legible times, and the ground slopes."""

import itertools

import numpy as np

from dln_jax.figures.soft_bodies import Moments, moments_figure, soft_body_drawing
from dln_jax.softbody.mesh.shapes import beam

MESH = beam(0.4, 0.2, 2, 1)


def test_times_lie_beside_their_snapshots_and_the_ground_of_a_frame_slopes():
    x = MESH.vertices + np.array([0.2, 0.0]) * np.arange(4)[:, None, None]
    figure = moments_figure([Moments("slides", MESH, x, 0.1 * np.arange(4), ground=0.0)])
    figure.draw_without_rendering()
    texts = figure.axes[0].texts
    assert [text.get_text() for text in texts] == ["0.00 s", "0.10 s", "0.20 s", "0.30 s"]
    assert not any(a.get_window_extent().overlaps(b.get_window_extent()) for a, b in itertools.combinations(texts, 2))
    axis = soft_body_drawing(MESH, MESH.vertices[None], slope=0.5)[0].axes[0]
    (line,) = axis.lines
    np.testing.assert_allclose(line.get_ydata(), 0.5 * np.asarray(line.get_xdata()))
    assert axis.get_ylim()[0] < min(line.get_ydata())
