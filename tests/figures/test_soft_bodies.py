"""Snapshots of soft bodies have legible times, and their ground may slope."""

import itertools

import numpy as np

from dln_jax.figures import Moments, moments_figure, soft_body_frame
from dln_jax.softbody.mesh import beam

MESH = beam(1.0, 0.5, 2, 1)


def test_times_lie_beside_their_snapshots_and_cover_no_other_time():
    x = MESH.vertices + np.array([0.4, 0.0]) * np.arange(4)[:, None, None]
    figure = moments_figure([Moments("slides", MESH, x, 0.1 * np.arange(4), ground=0.0)])
    figure.draw_without_rendering()
    boxes = [text.get_window_extent() for text in figure.axes[0].texts]
    assert [text.get_text() for text in figure.axes[0].texts] == ["0.00 s", "0.10 s", "0.20 s", "0.30 s"]
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))


def test_ground_of_a_frame_slopes():
    axis = soft_body_frame(MESH, MESH.vertices, slope=0.5).axes[0]
    (line,) = axis.lines
    np.testing.assert_allclose(line.get_ydata(), 0.5 * np.asarray(line.get_xdata()))
    assert axis.get_ylim()[0] < min(line.get_ydata())
