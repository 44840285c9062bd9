"""A walk has the files that a call enters and the arrows between them, and nothing of other libraries."""

import jax
import jax.numpy as jnp
import pytest

from dln_jax import dynamics
from dln_jax.scenes.pendulums import pendulum
from scripts.reports.walks import walk_of


@pytest.mark.slow
def test_files_are_in_the_order_of_their_first_call_and_arrows_join_them():
    scene = pendulum()
    plant = dynamics(scene.energies)
    walk = walk_of(lambda: jax.eval_shape(plant.mass_matrix, jnp.array([0.3])))
    assert walk.files[0] == "mechanics/dynamics.py" and "mechanics/arguments.py" in walk.files
    assert ("mechanics/dynamics.py", "mechanics/arguments.py") in walk.arrows
    assert all(before != after and {before, after} <= set(walk.files) for before, after in walk.arrows)
    assert all(not file.startswith("/") for file in walk.files)


def test_what_enters_no_file_of_the_library_is_an_empty_walk():
    assert walk_of(lambda: jnp.sin(1.0)) == ((), ())
