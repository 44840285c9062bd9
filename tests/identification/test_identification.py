"""From data to parameters: exact without noise, honest about what stays unknown, and reported in words."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from planar_arm import ARM, FRICTION, motions

from dln_jax.identification import identify, is_consistent, parameters_of
from dln_jax.identification.report import base_rows, findings, lost, parameter_rows, summary, text
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees import inertial_parameters, serial
from dln_jax.models.rigid_tree import make_rigid_tree
from dln_jax.types import InputError

MODEL = make_rigid_tree(ARM, friction=True)
ROUGH = MODEL.init(jax.random.key(0))._replace(inertias=jnp.asarray(0.7 * ARM.inertias))
TRUE = ROUGH._replace(inertias=ARM.inertias, armature=ARM.armature, **FRICTION)


@pytest.fixture(scope="module")
def clean():
    return identify(MODEL, ROUGH, motions(0), consistent=False)


def test_clean_data_give_the_base_parameters(clean):
    true = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(TRUE)])
    combinations = clean.base.combinations
    np.testing.assert_allclose(combinations @ clean.fit.theta, combinations @ true, atol=1e-10)
    assert len(combinations) == clean.fit.rank == 13
    known = np.array(clean.structure) == "not at all"
    np.testing.assert_array_equal(clean.theta[known], clean.known[known])
    assert clean.seen == clean.structure and not lost(clean)


def test_torques_of_other_motions_are_predicted(clean):
    test = motions(1)
    motion = dynamics(MODEL.energies(parameters_of(clean.theta, ROUGH)))
    predicted = jax.jit(jax.vmap(motion.inverse_dynamics))(test.q, test.qd, test.qdd)
    np.testing.assert_allclose(predicted, test.tau, atol=1e-9)


def test_noise_is_estimated_and_bodies_exist():
    result = identify(MODEL, ROUGH, motions(2, noise=0.1, trajectories=4))
    np.testing.assert_allclose(result.fit.noise, 0.1, rtol=0.1)
    assert result.consistent is not None and all(is_consistent(result.theta, result.columns))
    rows = base_rows(result)
    true = result.base.combinations @ np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(TRUE)])
    assert all(abs(row["value"] - value) < 5 * row["standard_error"] for row, value in zip(rows, true, strict=True))
    robust = identify(MODEL, ROUGH, motions(2, noise=0.1, trajectories=4), robust=True, consistent=False)
    np.testing.assert_allclose(robust.fit.noise, 0.1, rtol=0.15)


def test_a_joint_that_never_moves_is_said():
    """The other's parameters are result; what only its motion shows stays as the file has it."""
    data = motions(3, noise=0.01, still=(1,))
    result = identify(MODEL, ROUGH, data)
    names = result.columns.names
    lines = findings(result, data, ARM.names)
    assert lines[0].startswith("elbow: does not move; ")
    assert "armature_2" in lost(result) and "viscous_2" in lost(result)
    k = names.index("viscous_1")
    assert result.seen[k] == "alone" and abs(result.fit.theta[k] - FRICTION["viscous"][0]) < 0.05
    unseen = names.index("viscous_2")
    assert result.fit.theta[unseen] == result.known[unseen]
    np.testing.assert_array_equal(result.fit.standard_errors(np.eye(len(names)))[unseen], np.inf)


def test_words_and_rows(clean):
    page = text(clean)
    for words in ("h_x_1 + 0.5 m_2", "motions determine 11 alone, 4 in combination, 13 not at all: 13 base", "±"):
        assert words in page
    rows = {row["name"]: row for row in parameter_rows(clean)}
    assert rows["m_1"]["data"] == "not at all" and rows["m_1"]["standard_error"] is None
    assert rows["coulomb_2"]["standard_error"] < 1e-6
    assert "13 combinations" in summary(clean)[1]


def test_links_without_mass_stay_so():
    """As between two joints of one MJCF body."""
    frames = np.stack([np.eye(3)] * 2), np.zeros((2, 3))
    body = inertial_parameters(1.0, [0.1, 0.2, 0.3], np.diag([0.02, 0.03, 0.04]))
    tree = serial(*frames, [np.zeros(10), body], axes=[[1, 0, 0], [0, 1, 0]])
    model = make_rigid_tree(tree)
    data = motions(0, noise=1e-3, friction=False, tree=tree)
    result = identify(model, model.init(jax.random.key(0)), data)
    assert not result.theta[:10].any() and all(is_consistent(result.theta, result.columns))
    np.testing.assert_allclose(result.theta[10], 1.0, rtol=0.3)


def test_mistakes():
    data = motions(0, samples=30)
    with pytest.raises(InputError, match="the data have 2 joints, the robot 3"):
        identify(MODEL, ROUGH, data, joints=("revolute",) * 3)
    with pytest.raises(InputError, match="have no tau"):
        identify(MODEL, ROUGH, data._replace(estimated=("tau",)))
    with pytest.raises(InputError, match="leave one of them out"):
        identify(MODEL, ROUGH, data, robust=True, noise=[1.0, 1.0])
