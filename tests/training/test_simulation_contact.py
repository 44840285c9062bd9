"""Contact in `simulate`: two bodies of a user's mesh that fall on each other."""

import numpy as np
import pytest
from calls import assert_refused, command, json_of

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
    rows = [
        ("--scene drop --integrator midpoint --mesh", two_blocks, "use BACKWARD_EULER, BDF2"),
        ("--scene slope", "has no --contact"),
    ]
    assert_refused(capsys, simulate, rows, "--contact", out=tmp_path / "run")


@pytest.mark.slow
def test_blocks_that_fall_on_each_other_stay_apart(two_blocks, tmp_path):
    options = "--scene drop --contact --youngs-modulus 1e5 --seconds 0.5 --no-figures"
    command(simulate, options, "--mesh", two_blocks, "--out", tmp_path / "run")
    numbers = json_of(tmp_path / "run" / "metrics.json")
    # Their surfaces act on each other within 15 mm, a tenth of the shortest edge.
    assert numbers["steps_not_converged"] == 0 and 0 < numbers["least_distance_of_surfaces"] < 0.0149
