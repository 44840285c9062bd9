"""Contact in `simulate`: two bodies of a user's mesh that fall on each other."""

import numpy as np
import pytest
from calls import command, json_of, refused

from dln_jax.cli.commands import simulate
from dln_jax.softbody.mesh import beam


@pytest.fixture
def two_blocks(tmp_path):
    """One block above another, 0.15 m apart."""
    block = beam(1.0, 0.3, 4, 2)
    vertices = np.concatenate([block.vertices, block.vertices + np.array([0.3, 0.45])])
    elements = np.concatenate([block.elements, block.elements + len(block.vertices)])
    np.savez(tmp_path / "two.npz", vertices=vertices, elements=elements)
    return tmp_path / "two.npz"


def test_contact_is_refused_where_it_cannot_hold(capsys, two_blocks, tmp_path):
    mine = ("--scene", "drop", "--mesh", str(two_blocks), "--contact", "--out", str(tmp_path / "run"))
    assert "use BACKWARD_EULER, BDF2" in refused(capsys, simulate, *mine, "--integrator midpoint")
    assert "has no --contact" in refused(capsys, simulate, "--scene slope --contact")
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_blocks_that_fall_on_each_other_stay_apart(two_blocks, tmp_path):
    mine = ("--scene", "drop", "--mesh", str(two_blocks), "--youngs-modulus", "1e5", "--seconds", "0.5", "--no-figures")
    command(simulate, *mine, "--contact --out", str(tmp_path / "run"))
    numbers = json_of(tmp_path / "run" / "metrics.json")
    # Their surfaces act on each other within 15 mm, a tenth of the shortest edge.
    assert numbers["steps_not_converged"] == 0 and 0 < numbers["least_distance_of_surfaces"] < 0.0149
