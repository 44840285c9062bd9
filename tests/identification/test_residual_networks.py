"""A network is added where motions show that the tree is not all, and only there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from planar_arm import ARM

from dln_jax.data.schema import from_arrays
from dln_jax.data.splits import select
from dln_jax.identification.residual import Candidate, fit_residual
from dln_jax.learning.linear import fit_linear
from dln_jax.learning.model_selection import segments
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.residual import Residual, with_residual
from dln_jax.mechanics.trees import tree_system
from dln_jax.models.residual import ResidualParameters, make_residual
from dln_jax.models.rigid_tree import make_rigid_tree
from dln_jax.types import InputError

CANDIDATES = (Candidate(), Candidate(("potential",), 6))
SPRING = 4.0


def log(stiffness):
    """Six motions of 60 samples, of an arm whose second joint has a spring that is not of the tree."""
    random, t = np.random.default_rng(0), np.tile(np.linspace(0, 3, 60), 6)
    trajectory = np.repeat(np.arange(6), 60)
    a, b, w = random.normal(size=(6, 2)), random.normal(size=(6, 2)), random.uniform(0.5, 2, (6, 2))
    angle = w[trajectory] * t[:, None]
    c, s = a[trajectory] * np.cos(angle), b[trajectory] * np.sin(angle)
    q = c + s
    qd = w[trajectory] * (b[trajectory] * np.cos(angle) - a[trajectory] * np.sin(angle))
    qdd = -(w[trajectory] ** 2) * q
    true = with_residual(tree_system(ARM), Residual(potential=lambda q: stiffness * jnp.cos(2 * q[1])))
    tau = jax.jit(jax.vmap(dynamics(true).inverse_dynamics))(q, qd, qdd) + 0.01 * random.normal(size=q.shape)
    return from_arrays({"t": t, "q": q, "qd": qd, "qdd": qdd, "tau": np.asarray(tau), "trajectory": trajectory})


@pytest.mark.slow
@pytest.mark.parametrize(("stiffness", "added"), [(SPRING, True), (0.0, False)])
def test_a_network_is_added_only_where_it_helps(stiffness, added):
    data = log(stiffness)
    train, validation, test = (select(data, which) for which in ([0, 1, 2], [3, 4], [5]))
    rigid = make_rigid_tree(ARM, friction=True)
    identified = fit_linear(rigid, train, negligible=1e-12).parameters
    result = fit_residual(rigid, identified, ARM.needs, train, validation, candidates=CANDIDATES, iterations=30)
    assert bool(result.chosen.terms) == added

    def error(model, parameters):
        tau = jax.jit(jax.vmap(dynamics(model.energies(parameters)).inverse_dynamics))(test.q, test.qd, test.qdd)
        return float(np.mean((tau - test.tau) ** 2))

    if added:
        assert isinstance(result.parameters, ResidualParameters)
        assert error(result.model, result.parameters) < 0.2 * error(rigid, identified)
    else:
        assert result.model is rigid


def test_segments_stay_within_trajectories():
    data = log(0.0)
    numbers = segments(data, 1.0)
    assert len(set(numbers)) == 6 * 4  # the last sample, at 3 s, begins a segment of its own
    assert all(len(set(data.trajectory[numbers == number])) == 1 for number in set(numbers))


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"terms": ()}, "terms are"),
        ({"terms": ("potential", "potential")}, "terms are"),
        ({"torque_scale": 0.0}, "torque_scale"),
        ({"width": 0}, "width"),
    ],
)
def test_what_is_no_residual_is_refused(keywords, message):
    with pytest.raises(InputError, match=message):
        make_residual(ARM.needs, **keywords)


def test_candidates_start_with_none():
    with pytest.raises(InputError, match="candidates start with a network"):
        fit_residual(make_rigid_tree(ARM), None, ARM.needs, log(0.0), log(0.0), candidates=CANDIDATES[1:])
