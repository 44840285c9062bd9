"""--refine motions: a tree with wrong bodies predicts held-out motions longer once they are fitted to motions."""

import jax
import numpy as np
from motions import sums_of_sines

from dln_jax import Needs, describe, dynamics
from dln_jax.data.schema import from_arrays
from dln_jax.data.splits import Split
from dln_jax.mechanics.trees.inertia import inertial_parameters
from dln_jax.models.trees import SerialTreeParameters, make_serial_tree
from dln_jax.training.dynamics.methods.learned_tree import refined_by_motions

NEEDS = Needs(joints=("revolute",), friction=True)
DESCRIPTION = describe(
    "learned-tree", precision="f64", needs=NEEDS, parents=[-1], acceleration=9.81, velocity_scale=0.01
)
LINK = inertial_parameters(2.0, [0.2, 0.05, 0.1], np.diag([0.02, 0.04, 0.05]))
# A pendulum: its axis is turned by 90 degrees from the direction against gravity.
TRUE = SerialTreeParameters(
    *map(np.array, ([[np.pi / 2, 0, 0]], [[0.0, 0, 0]], [LINK], [0.1], [0.2], [0.5], [0.1]))
)  # fmt: skip


def motion(seed):
    """A sum of sines for 4 s, with torques with noise."""
    random, t = np.random.default_rng(seed), np.linspace(0, 4, 81)
    q, qd, qdd = sums_of_sines(t, *random.uniform([0.3, 0.5, 0], [0.8, 3, 6], (1, 3, 3)).transpose(2, 0, 1))
    known = dynamics(make_serial_tree(NEEDS, velocity_scale=0.01).energies(TRUE))
    tau = jax.jit(jax.vmap(known.inverse_dynamics))(q, qd, qdd) + 0.05 * random.normal(size=(81, 1))
    columns = {"t": t, "q": q, "qd": qd, "qdd": qdd, "tau": np.asarray(tau)}
    return from_arrays({**columns, "trajectory": np.zeros(81, int)})


def test_motions_mend_the_bodies_of_a_tree_and_the_line_says_so():
    wrong = TRUE._replace(inertias=1.2 * TRUE.inertias, coulomb=0.5 * TRUE.coulomb)
    mended = refined_by_motions(NEEDS, DESCRIPTION, Split(*map(motion, range(3))), wrong, window=0.3)
    (before, after), (by_torques, validated) = mended.test, mended.validation
    assert mended.kept and after > 2 * before and validated > by_torques
    assert mended.line.endswith("; kept") and f"test motions predicted for {after:.3g} s, by torques" in mended.line
    assert mended.metrics == {"by_torques_vpt_seconds": before, "by_motions_vpt_seconds": after, "refinement_kept": 1}
