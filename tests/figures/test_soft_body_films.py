"""Snapshots and films of bodies in the plane: legible times, what faces the viewer, and where shadows fall."""

import itertools

import numpy as np
from calls import one_line
from PIL import Image

from dln_jax.figures.soft_bodies import Moments, moments_figure
from dln_jax.figures.soft_body_animations import soft_body_frame
from dln_jax.figures.soft_body_films import OBLIQUE, Slab, _shadow, _side_faces, write_slab_film
from dln_jax.softbody.mesh.mesh import boundary
from dln_jax.softbody.mesh.shapes import beam, box

MESH = beam(0.4, 0.2, 2, 1)
GROUND = np.array([(-0.2, 0.0), (0.5, 0.0), (0.5, -0.3), (1.0, -0.3)])


def test_only_faces_above_and_to_the_right_are_seen_and_the_upper_ones_are_brighter():
    edges = MESH.vertices[boundary(MESH)]
    quads, lit = _side_faces(edges, np.full((len(edges), 3), 0.5), 0.1 * OBLIQUE)
    above, right = (quads[:, :2, axis].min(axis=1) == limit for axis, limit in ((1, 0.2), (0, 0.4)))
    assert np.sum(above & ~right) == 2 and np.sum(right & ~above) == 1 and len(quads) == 3
    assert lit[above].min() > lit[right].max()


def test_a_shadow_falls_straight_down_on_every_step_below_and_fades_with_height():
    low, high = (_shadow(MESH.vertices + np.array([0.3, height]), GROUND, 0.1 * OBLIQUE) for height in (0.0, 0.5))
    spans = [(quad[:2, 0].tolist(), quad[0, 1]) for quad in low[0]]
    assert spans == [([0.3, 0.5], 0.0), ([0.5, 0.7], -0.3)]
    assert low[1] > high[1] > 0


def test_a_film_has_a_frame_for_every_stride_and_moves(tmp_path):
    t = 0.1 * np.arange(5)
    x = MESH.vertices + np.stack([t, 0 * t], axis=1)[:, None]
    bar = [Slab(np.array([(0.0, 0.3), (0.4, 0.3), (0.4, 0.4), (0.0, 0.4)]), "0.4")]
    options = {"depth": 0.1, "ground": GROUND, "stride": 2, "slabs": lambda k: bar, "label": str, "width": 2.0}
    write_slab_film(tmp_path / "a.gif", MESH, x, t, **options)
    with Image.open(tmp_path / "a.gif") as film:
        frames = [np.asarray(film.convert("RGB")) for k in range(film.n_frames) if not film.seek(k)]
    assert len(frames) == 3
    assert (frames[0] != frames[2]).any(axis=2).mean() > 0.01
    assert (frames[0][0, 0] == 255).all()
    solid = box((1.0, 1.0, 1.0), (1, 1, 1))
    for mesh, given, words in (
        (MESH, x[:3], r"\[3, 6, 2\] at 2 times; expected"),
        (solid, solid.vertices[None], "in the plane"),
    ):
        with one_line(words):
            write_slab_film(tmp_path / "b.gif", mesh, given, t[:2], **options)
    assert not (tmp_path / "b.gif").exists()


def test_times_lie_beside_their_snapshots_and_the_ground_of_a_frame_slopes():
    x = MESH.vertices + np.array([0.2, 0.0]) * np.arange(4)[:, None, None]
    figure = moments_figure([Moments("slides", MESH, x, 0.1 * np.arange(4), ground=0.0)])
    figure.draw_without_rendering()
    texts = figure.axes[0].texts
    assert [text.get_text() for text in texts] == ["0.00 s", "0.10 s", "0.20 s", "0.30 s"]
    assert not any(a.get_window_extent().overlaps(b.get_window_extent()) for a, b in itertools.combinations(texts, 2))
    axis = soft_body_frame(MESH, MESH.vertices, slope=0.5).axes[0]
    (line,) = axis.lines
    np.testing.assert_allclose(line.get_ydata(), 0.5 * np.asarray(line.get_xdata()))
    assert axis.get_ylim()[0] < min(line.get_ydata())
