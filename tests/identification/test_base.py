"""Base parameters of a planar arm are those of the textbook, and every direction that no force shows is found."""

import jax
import numpy as np
import pytest
from planar_arm import ARM, LENGTH

from dln_jax.identification.base import base_parameters, determinacy, in_words, null_directions
from dln_jax.identification.equations import columns_of, compressed, flat, regressor_of
from dln_jax.identification.identify import random_states
from dln_jax.models.rigid_tree import make_rigid_tree


@pytest.fixture(scope="module")
def planar():
    """Phi of random states, as a triangle, and its columns."""
    model = make_rigid_tree(ARM, friction=True)
    known = model.init(jax.random.key(0))
    equations = compressed(regressor_of(model, known, random_states(ARM.joints, 60, 0)))
    return equations.triangles.reshape(-1, 29)[:, :-1], columns_of(known), flat(known)


def test_those_of_the_textbook(planar):
    A, columns, _ = planar
    base = base_parameters(A, columns)
    assert base.words == (
        "h_x_1 + 0.5 m_2",
        "h_y_1",
        "I_zz_1 + 0.25 m_2 + armature_1",
        "h_x_2",
        "h_y_2",
        "I_zz_2",
        "armature_2",
        *(f"{law}_{joint}" for law in ("viscous", "coulomb", "offset") for joint in (1, 2)),
    )
    by_name = dict(zip(base.words, base.combinations, strict=True))
    row = by_name["I_zz_1 + 0.25 m_2 + armature_1"]
    np.testing.assert_allclose(row[columns.names.index("m_2")], LENGTH**2, rtol=1e-12)
    # Forces depend on them alone.
    np.testing.assert_allclose(A[:, list(base.independent)] @ base.combinations, A, atol=1e-9 * abs(A).max())


def test_what_is_known_alone_in_combination_or_never(planar):
    A, columns, _ = planar
    kinds = dict(zip(columns.names, determinacy(null_directions(A)), strict=True))
    assert {name for name, kind in kinds.items() if kind == "in combination"} == {
        "h_x_1",
        "I_zz_1",
        "m_2",
        "armature_1",
    }
    assert kinds["m_1"] == kinds["I_xx_2"] == kinds["h_z_2"] == "not at all"
    assert kinds["h_y_1"] == kinds["I_zz_2"] == kinds["armature_2"] == kinds["coulomb_1"] == "alone"


def test_directions_without_effect_have_none(planar):
    A, columns, _ = planar
    lengths = np.linalg.norm(A, axis=0)
    seen = lengths > 1e-10 * lengths.max()
    directions = null_directions(A)
    np.testing.assert_allclose(directions @ directions.T, np.eye(len(directions)), atol=1e-12)
    assert len(directions) == len(columns.names) - 13
    assert abs(A[:, seen] / lengths[seen] @ directions[:, seen].T).max() < 1e-10


def test_words():
    assert in_words(np.array([-0.5, 1.0, 0.0, -1.0]), ("a", "b", "c", "d")) == "b - 0.5 a - d"
    assert in_words(np.array([-2.0, 0.0]), ("a", "b")) == "-2 a"
