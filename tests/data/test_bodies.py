"""The order of bodies' coordinates from the balance of forces, on motions that numpy and scipy made."""

import jax
import jax.numpy as jnp
import numpy as np
from calls import one_line
from published_motions import published_arrays

from dln_jax import Needs, flow
from dln_jax.data.bodies import Bodies, find_bodies, imbalance
from dln_jax.models.hamiltonian import make_pairwise_hamiltonian


def by_body(x, count):
    """Axis by axis to body by body."""
    return x.reshape(-1, 2, count).swapaxes(1, 2).reshape(x.shape)


def test_order_is_read_off_forces():
    for task, count in (("two-body", 2), ("three-body", 3)):
        force = published_arrays(task, 7, trajectories=4)["pd"]
        assert find_bodies(force) == Bodies(2, "axes")
        assert find_bodies(by_body(force, count)) == Bodies(2, "bodies")
        assert imbalance(force, Bodies(2, "axes")) < 1e-12 < 0.3 < imbalance(force, Bodies(2, "bodies"))
        noisy = force + 0.05 * force.std() * np.random.default_rng(0).normal(size=force.shape)
        assert find_bodies(noisy) == Bodies(2, "axes") and find_bodies(force, order="bodies").order == "bodies"


def test_bodies_in_space_are_told_from_bodies_in_a_plane_and_forces_without_balance_name_none():
    random = np.random.default_rng(0)
    pull = random.normal(size=(50, 3))
    assert find_bodies(np.concatenate([pull, -pull], axis=1)) == Bodies(3, "bodies")
    assert find_bodies(np.stack([pull, -pull], axis=2).reshape(50, 6)) == Bodies(3, "axes")
    for forces in (random.normal(size=(200, 4)), np.zeros((10, 4)), random.normal(size=(200, 3))):
        assert find_bodies(forces) is None


def test_a_pairwise_model_is_the_same_in_both_orders():
    needs, rates = Needs(("prismatic",) * 6), []
    q, p = np.random.default_rng(0).normal(size=(2, 6))
    for order, states in (("axes", (q, p)), ("bodies", (by_body(q, 3), by_body(p, 3)))):
        model = make_pairwise_hamiltonian(needs, order=order, width=2, depth=1, alike=False, dtype=jnp.float64)
        rates.append(jax.jit(flow(model.energies(model.init(jax.random.key(0)))).rates)(*states))
    for by_axis, of_bodies in zip(*rates, strict=True):
        np.testing.assert_allclose(by_body(by_axis, 3), of_bodies, rtol=1e-12)
    with one_line("order is 'columns'"):
        make_pairwise_hamiltonian(needs, order="columns")  # pyright: ignore[reportArgumentType]
