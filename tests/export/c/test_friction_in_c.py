"""Each law of friction in the joints of a tree, in C as in JAX."""

import jax
import numpy as np
import pytest

from dln_jax.export import functions_of_system
from dln_jax.export.c import export_c, load_c
from dln_jax.mechanics import trees
from dln_jax.mechanics.friction import LAWS, coefficients_of, joint_dissipation
from dln_jax.mechanics.joint_friction import Load, with_friction

LINK = trees.inertial_parameters(2.0, [0.05, 0.02, 0.1], np.diag([0.02, 0.03, 0.01]))
ARM = trees.serial(*trees.dh_frames([[0, 0, 0.3, 0], [-np.pi / 2, 0.1, 0, 0]]), [LINK] * 2, armature=[0.1, 0.05])


@pytest.mark.parametrize("law", LAWS)
def test_c_has_the_friction_of_jax(law, tmp_path):
    coefficients = {name: np.array([0.2, 0.1]) for name in coefficients_of([law])}
    load = Load(np.array([0.2, 0.1]), 0.02) if law == "load" else None
    system = with_friction(trees.tree_system(ARM), joint_dissipation(**coefficients, velocity_scale=0.02), load)
    every = functions_of_system(system, 2, dtype=np.float64)
    names = ("inverse_dynamics", "forward_dynamics", *(("friction_jacobian",) if law != "load" else ()))
    export_c({name: every[name] for name in names}, tmp_path / "c")
    exported = load_c(tmp_path / "c")
    for rates in ([0.0, 0.0], [0.01, -0.03], [-1.0, 2.0], [50.0, 1e-6]):
        state = {"q": [0.3, -0.8], "qd": rates, "qdd": [1.0, -2.0], "tau": [2.0, -30.0]}
        for name in names:
            function, examples = every[name]
            keys = ("q", "qd", "qdd" if name == "inverse_dynamics" else "tau")[: len(examples)]
            given = [np.array(state[key]) for key in keys]
            wanted = jax.tree.leaves(jax.jit(function)(*given))
            found = getattr(exported, name)(*given)
            found = found if isinstance(found, tuple) else (found,)
            for a, b in zip(found, wanted, strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
