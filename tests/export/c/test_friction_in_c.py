"""Each law of friction in the joints of a tree, in C as in JAX."""

import shutil

import numpy as np
import pytest
from comparison import in_c, in_jax

from dln_jax.export import functions_of_system
from dln_jax.mechanics import trees
from dln_jax.mechanics.friction import LAWS, coefficients_of, joint_dissipation
from dln_jax.mechanics.joint_friction import Load, with_friction

LINK = trees.inertial_parameters(2.0, [0.05, 0.02, 0.1], np.diag([0.02, 0.03, 0.01]))
ARM = trees.serial(*trees.dh_frames([[0, 0, 0.3, 0], [-np.pi / 2, 0.1, 0, 0]]), [LINK] * 2, armature=[0.1, 0.05])
RATES = ([0.0, 0.0], [0.01, -0.03], [-1.0, 2.0], [50.0, 1e-6])
LAST = {"inverse_dynamics": [1.0, -2.0], "forward_dynamics": [2.0, -30.0], "friction_jacobian": None}
"""Names of the functions, and their argument after q and qd: qdd, tau, or none."""


@pytest.mark.slow
@pytest.mark.skipif(not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="there is no C compiler on the PATH")
def test_c_has_the_friction_of_jax(tmp_path):
    functions, states = {}, {}
    for law in LAWS:
        coefficients = {name: np.array([0.2, 0.1]) for name in coefficients_of([law])}
        load = Load(np.array([0.2, 0.1]), 0.02) if law == "load" else None
        system = with_friction(trees.tree_system(ARM), joint_dissipation(**coefficients, velocity_scale=0.02), load)
        of_law = functions_of_system(system, 2, dtype=np.float64)
        for name, last in LAST.items():
            if name == "friction_jacobian" and law == "load":
                continue
            functions[f"{law}_{name}"] = of_law[name]
            rows = [([0.3, -0.8], rates, last)[: 2 + (last is not None)] for rates in RATES]
            states[f"{law}_{name}"] = [tuple(map(np.array, row)) for row in rows]
    got, expected = in_c(functions, states, tmp_path), in_jax(functions, states)
    for name in functions:
        for ours, theirs in zip(got[name], expected[name], strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12, err_msg=name)
