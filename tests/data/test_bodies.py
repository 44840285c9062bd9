"""The order of bodies' coordinates from the balance of forces, on motions that numpy and scipy made."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.data.bodies import Bodies, arrangements, find_bodies, imbalance
from dln_jax.mechanics.equations import flow
from dln_jax.models.n_body import make_pairwise_hamiltonian
from dln_jax.types import InputError, Needs
from tests.published_motions import published_arrays

COUNTS = {"two-body": 2, "three-body": 3}


@pytest.fixture(scope="module", params=list(COUNTS))
def published(request):
    return COUNTS[request.param], published_arrays(request.param, 7, trajectories=4)


def by_body(x, count):
    """Axis by axis to body by body."""
    return x.reshape(-1, 2, count).swapaxes(1, 2).reshape(x.shape)


def test_order_is_read_off_forces(published):
    count, arrays = published
    force = arrays["pd"]
    assert find_bodies(force) == Bodies(2, "axes")
    assert find_bodies(by_body(force, count)) == Bodies(2, "bodies")
    assert imbalance(force, Bodies(2, "axes")) < 1e-12 < 0.3 < imbalance(force, Bodies(2, "bodies"))
    noisy = force + 0.05 * force.std() * np.random.default_rng(0).normal(size=force.shape)
    assert find_bodies(noisy) == Bodies(2, "axes")
    assert find_bodies(force, order="bodies") in [each for each in arrangements(2 * count) if each.order == "bodies"]


def test_forces_that_balance_in_no_order_name_none():
    random = np.random.default_rng(0)
    for forces in (random.normal(size=(200, 4)), np.zeros((10, 4)), random.normal(size=(200, 3))):
        assert find_bodies(forces) is None
    assert arrangements(6) == [Bodies(2, "bodies"), Bodies(2, "axes"), Bodies(3, "bodies"), Bodies(3, "axes")]


def test_bodies_in_space_are_told_from_bodies_in_a_plane():
    pull = np.random.default_rng(0).normal(size=(50, 3))
    assert find_bodies(np.concatenate([pull, -pull], axis=1)) == Bodies(3, "bodies")
    assert find_bodies(np.stack([pull, -pull], axis=2).reshape(50, 6)) == Bodies(3, "axes")


def test_a_pairwise_model_is_the_same_in_both_orders():
    count, arrays = 3, published_arrays("three-body", 7, trajectories=1)
    sizes = {"width": 4, "depth": 1, "alike": False, "dtype": jnp.float64}
    models = {
        order: make_pairwise_hamiltonian(Needs(("prismatic",) * 2 * count), order=order, **sizes)
        for order in ("bodies", "axes")
    }
    parameters = models["bodies"].init(jax.random.key(0))
    parameters = jax.tree.map(lambda leaf: leaf + 0.1 * np.arange(leaf.size).reshape(leaf.shape), parameters)
    q, p = arrays["q"][:5], arrays["p"][:5]
    of_axes, of_bodies = (
        jax.jit(jax.vmap(flow(models[order].energies(parameters)).rates))(*states)
        for order, states in (("axes", (q, p)), ("bodies", (by_body(q, count), by_body(p, count))))
    )
    for one, other in zip(of_axes, of_bodies, strict=True):
        np.testing.assert_allclose(by_body(np.asarray(one), count), other, rtol=1e-12)
    with pytest.raises(InputError, match="order is 'columns'"):
        make_pairwise_hamiltonian(Needs(("prismatic",) * 4), order="columns")  # pyright: ignore[reportArgumentType]
