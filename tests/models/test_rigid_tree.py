"""Frictions that a rigid tree cannot have."""

from calls import one_line
from planar_arm import ARM

from dln_jax.models.trees import make_rigid_tree


def test_frictions_that_no_tree_has_are_refused():
    for keywords, message in (
        ({"friction": ("viscous",), "load": 0.1}, "load is 0.1, but friction has viscous; add 'load'"),
        ({"friction": ("load",), "load": 1.0}, "load is 1.0; expected a coefficient"),
        ({"friction": ("stribeck",), "stribeck_velocity": (0.1, -1.0)}, "stribeck_velocity is"),
    ):
        with one_line(message):
            make_rigid_tree(ARM, **keywords)
