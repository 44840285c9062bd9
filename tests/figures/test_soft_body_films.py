"""Films of bodies in the plane: what faces the viewer, where shadows fall, and what is refused."""

import numpy as np
import pytest
from PIL import Image

from dln_jax.figures.soft_body_films import OBLIQUE, Slab, _shadow, _side_faces, write_slab_film
from dln_jax.softbody.mesh import beam, boundary, box
from dln_jax.types import InputError

MESH = beam(0.4, 0.2, 2, 1)
GROUND = np.array([(-0.2, 0.0), (0.5, 0.0), (0.5, -0.3), (1.0, -0.3)])


def film(path, x, t, **options):
    write_slab_film(path, MESH, x, t, depth=0.1, ground=GROUND, **options)


def test_only_faces_to_the_right_and_above_are_seen():
    edges = MESH.vertices[boundary(MESH)]
    quads, _ = _side_faces(edges, np.ones((len(edges), 3)), 0.1 * OBLIQUE)
    middles = quads[:, :2].mean(axis=1)
    assert len(quads) == 3  # two edges above, one on the right
    assert np.all((middles[:, 1] == 0.2) | (middles[:, 0] == 0.4))


def test_upper_faces_are_brighter_than_those_on_the_right():
    edges = MESH.vertices[boundary(MESH)]
    quads, lit = _side_faces(edges, np.full((len(edges), 3), 0.5), 0.1 * OBLIQUE)
    above = quads[:, 0, 1] == quads[:, 1, 1]
    assert lit[above].min() > lit[~above].max()


def test_a_shadow_falls_straight_down_on_every_step_below_and_fades_with_height():
    low, high = (_shadow(MESH.vertices + np.array([0.3, height]), GROUND, 0.1 * OBLIQUE) for height in (0.0, 0.5))
    spans = [(quad[:2, 0].tolist(), quad[0, 1]) for quad in low[0]]
    assert spans == [([0.3, 0.5], 0.0), ([0.5, 0.7], -0.3)]
    assert low[1] > high[1] > 0


def test_a_film_has_a_frame_for_every_stride_and_moves(tmp_path):
    t = 0.1 * np.arange(5)
    x = MESH.vertices + np.stack([t, 0 * t], axis=1)[:, None]
    bar = np.array([(0.0, 0.3), (0.4, 0.3), (0.4, 0.4), (0.0, 0.4)])
    film(tmp_path / "a.gif", x, t, stride=2, slabs=lambda k: [Slab(bar, "0.4")], label=lambda k: f"{k}", width=2.0)
    with Image.open(tmp_path / "a.gif") as written:
        frames = []
        for k in range(written.n_frames):
            written.seek(k)
            frames.append(np.asarray(written.convert("RGB")))
    assert len(frames) == 3
    assert (frames[0] != frames[2]).any(axis=2).mean() > 0.01
    assert (frames[0][0, 0] == 255).all()


def test_motions_that_do_not_fit_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"positions have shape \[3, 6, 2\] at 2 times; expected"):
        film(tmp_path / "a.gif", np.tile(MESH.vertices, (3, 1, 1)), np.zeros(2))
    solid = box((1.0, 1.0, 1.0), (1, 1, 1))
    with pytest.raises(InputError, match="mesh in the plane"):
        write_slab_film(tmp_path / "a.gif", solid, solid.vertices[None], np.zeros(1), depth=0.1, ground=GROUND)
    assert not list(tmp_path.iterdir())
