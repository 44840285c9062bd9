"""The one pass and its ensembles against autodiff of a plain network."""

from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax.nn import activations, differential_mlp
from dln_jax.nn.differential_mlp import value, value_and_jacobian, value_and_pull_back, value_jacobian_and_hessian

GELU = activations.gelu


def plain_derivatives(layers, x, *, activation):
    """Value, Jacobian and Hessian by autodiff."""

    def network(x):
        for weight, bias in layers[:-1]:
            x = activation.value(x @ weight + bias)
        return x @ layers[-1][0] + layers[-1][1]

    return network(x), jax.jacfwd(network)(x), jax.hessian(network)(x)


def random_network(sizes, batch=()):
    """Layers with biases, and x, made by NumPy: nothing to compile."""
    random = np.random.default_rng(0)
    layers = tuple(
        (jnp.asarray(random.normal(size=(a, b)) / np.sqrt(a)), jnp.asarray(random.normal(size=b) / 2))
        for a, b in pairwise(sizes)
    )
    return layers, jnp.asarray(random.normal(size=(*batch, sizes[0])))


def assert_close(got, expected, tolerance=1e-12):
    """Relative to the largest entry of each array, and absolute below 1."""
    assert jax.tree.structure(got) == jax.tree.structure(expected)
    for ours, theirs in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert ours.shape == theirs.shape and ours.dtype == theirs.dtype
        scale = max(1.0, np.abs(np.asarray(theirs)).max())
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=tolerance * scale)


@pytest.mark.parametrize(
    ("sweep", "sizes"),
    [
        ("forward", (7, 1)),
        ("forward", (3, 5, 4, 2)),
        ("backward", (3, 5, 4, 2)),
        ("forward", (1, 4, 3)),
        ("backward", (2, 4, 3, 2, 3, 1)),
    ],
)
def test_either_sweep_is_exact_in_a_batch(sweep, sizes, monkeypatch):
    monkeypatch.setattr(differential_mlp, "cheaper_jacobian", lambda sizes: sweep)
    monkeypatch.setattr(differential_mlp, "cheaper_hessian", lambda sizes: sweep)
    layers, xs = random_network(sizes, batch=(6,))
    w = jnp.arange(1.0, 1 + sizes[-1])

    @jax.jit
    @partial(jax.vmap, in_axes=(None, 0))
    def both(layers, x):
        one_pass = value_jacobian_and_hessian(layers, x, activation=GELU)
        first = value_and_jacobian(layers, x, activation=GELU)
        plain = plain_derivatives(layers, x, activation=GELU)
        y, pull_back = value_and_pull_back(layers, x, activation=GELU)
        return (one_pass, first, y, pull_back(w)), (plain, plain[:2], plain[0], w @ plain[1])

    assert_close(*both(layers, xs))


@pytest.mark.as_users_compile
def test_parameter_gradients_equal_those_through_autodiff():
    """A loss on value, Jacobian and Hessian."""

    @partial(jax.jit, static_argnums=0)
    @partial(jax.grad, argnums=1)
    def slope(derivatives, layers, x):
        return sum(jnp.sum(jnp.sin(array) + array**2) for array in derivatives(layers, x, activation=GELU))

    # Second derivatives of the first go forward, of the second backward.
    for sizes in ((1, 3, 3, 2), (4, 3, 3, 1)):
        network = random_network(sizes)
        expected = slope(plain_derivatives, *network)
        assert_close(slope(value_jacobian_and_hessian, *network), expected, tolerance=1e-11)


def test_dtype_is_that_of_the_parameters():
    def network(dtype):
        layers = differential_mlp.init(jax.random.key(0), (2, 4, 4, 1), dtype=dtype)
        return layers, value_jacobian_and_hessian(layers, jnp.ones(2, dtype), activation=activations.gelu)

    for dtype, expected in ((jnp.float32, jnp.float32), (float, jnp.float64)):  # float: JAX's default, 64 bits here
        results = jax.eval_shape(partial(network, dtype))
        assert {leaf.dtype for leaf in jax.tree.leaves(results)} == {jnp.dtype(expected)}


def test_ensemble_equals_a_loop_over_its_members():
    sizes, members, key, x = (2, 4, 2), 3, jax.random.key(7), jnp.asarray([0.3, -0.8])
    normal = jax.nn.initializers.normal(0.5)
    init = jax.jit(partial(differential_mlp.init, sizes=sizes, bias=normal))
    stacked = jax.jit(partial(differential_mlp.init_ensemble, sizes=sizes, members=members, bias=normal))(key)
    network = jax.jit(partial(value_and_jacobian, activation=GELU))
    outputs = []
    for index, own in enumerate(jax.random.split(key, members)):
        member = jax.tree.map(lambda leaf, index=index: leaf[index], stacked)
        assert_close(member, init(own))
        outputs.append(network(member, x))
    means, spreads = jax.jit(partial(differential_mlp.mean_and_spread, network))(stacked, x)
    for of_members, mean, spread in zip(zip(*outputs, strict=True), means, spreads, strict=True):
        assert_close(mean, np.mean(of_members, axis=0))
        assert_close(spread, np.std(of_members, axis=0, ddof=1))


def test_initial_weights_follow_glorot():
    sizes = (3, 200, 100, 1)
    layers = jax.jit(partial(differential_mlp.init, sizes=sizes))(jax.random.key(0))
    for weight, bias in jax.tree.map(np.asarray, layers):
        limit = np.sqrt(6 / sum(weight.shape))
        assert np.abs(weight).max() <= limit and not bias.any()
        assert float(weight.std()) == pytest.approx(limit / np.sqrt(3), rel=0.15)


def test_wrong_states_layers_and_sizes_are_refused():
    (first, last), x = random_network((2, 4, 1))
    for function in (value, value_and_jacobian, value_jacobian_and_hessian):
        for shape in ((), (3,), (2, 1)):
            with one_line(r"x has shape .*expected \(2,\), one state"):
                function((first, last), jnp.zeros(shape), activation=GELU)
    for layers in ((), (last, first), ((first[0], last[1]), last)):
        with one_line("expected one network"):
            value(layers, x, activation=GELU)
    members = jax.tree.map(lambda leaf: leaf[None], (first, last))
    with one_line(r"jax\.vmap for an ensemble"):
        value_and_jacobian(members, x, activation=GELU)
    with one_line("1 member; a spread needs at least 2"):
        differential_mlp.mean_and_spread(partial(value, activation=GELU), members, x)
    for sizes in ((), (2,), (2, 0, 1)):
        with one_line("sizes are"):
            differential_mlp.init(jax.random.key(0), sizes)
