"""Samples of functions: the published noise, exact grids, refusals, units, and the residuals that read them."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from numpy.testing import assert_allclose, assert_array_equal

from dln_jax import fit
from dln_jax.commands.functions.networks import errors, layers_in_own_units, predict, standard_units, to_units
from dln_jax.data import functions
from dln_jax.data.functions import FunctionSamples, published, published_grid
from dln_jax.learning import functions as regression
from dln_jax.learning.engine.problem import mean_square
from dln_jax.learning.functions import Network, published_adam, residual, targets
from dln_jax.nn import differential_mlp
from dln_jax.nn.activations import cos, tanh

CASES = (
    ("sin", 100, lambda x: jnp.sin(x[0])),
    ("cos_sin", 2500, lambda x: jnp.cos(x[0]) * jnp.sin(x[1])),
)


def arrays(**changes):
    """Twelve samples of a function of three inputs and two outputs."""
    random = np.random.default_rng(0)
    shapes = {"x": (12, 3), "y": (12, 2), "dy": (12, 2, 3), "d2y": (12, 2, 3, 3)}
    data = {**{key: random.normal(size=shape) for key, shape in shapes.items()}, **changes}
    return {key: value for key, value in data.items() if value is not None}


def exact(function, x):
    """Value, gradient and Hessian of a scalar function by autodiff."""
    parts = jax.jit(jax.vmap(lambda x: (function(x), jax.grad(function)(x), jax.hessian(function)(x))))(x)
    return FunctionSamples(x, *(np.asarray(part)[:, None] for part in parts))


def test_grids_are_exact_and_samples_have_the_published_noise_on_everything():
    for name, points, function in CASES:
        test = published_grid(name)
        assert len(test.x) == points
        assert_allclose([test.x.min(), test.x.max()], [-np.pi, np.pi])
        for ours, theirs in zip(test, exact(function, test.x), strict=True):
            assert_allclose(ours, theirs, atol=1e-14)
        noisy, clean = published(name), published(name, noise=0.0)
        assert noisy.x.shape == (25_600, test.x.shape[1])
        true = exact(function, clean.x)
        for key, ours, truth in zip(FunctionSamples._fields, noisy, true, strict=True):
            error = ours - truth
            assert_allclose(error.std(), 1e-3, rtol=0.02, err_msg=key)
            assert_allclose(error.mean(), 0, atol=2e-5, err_msg=key)
        # The noise on x is not that on the value: residuals of the truth at the stored x have both.
        residuals = noisy.dy - exact(function, noisy.x).dy
        expected = 1e-6 + 1e-6 * np.mean(np.sum(true.d2y**2, axis=-1))
        assert_allclose(np.mean(residuals**2), expected, rtol=0.03)
        assert_array_equal(noisy.d2y, np.swapaxes(noisy.d2y, -1, -2))


def test_generators_follow_their_seed_and_bound():
    one, same, other = (published("cos_sin", samples=500, seed=seed, bound=2.0).x for seed in (3, 3, 4))
    assert_array_equal(one, same)
    assert abs(one - other).max() > 0.1 and 1.9 < abs(one).max() < 2.01


def test_a_file_is_read_back_with_or_without_derivatives_and_axes_of_length_one(tmp_path):
    full = arrays()
    np.savez(tmp_path / "mine.npz", **full, gradient=np.zeros(2))
    data, remarks = functions.load(tmp_path / "mine.npz")
    assert remarks == ("not read: gradient",)
    for ours, theirs in zip(data, full.values(), strict=True):
        assert_array_equal(ours, theirs)
    dy, d2y = full["dy"][:, 0], full["d2y"][:, 0]
    data = functions.from_arrays(arrays(y=full["y"][:, :1], dy=dy, d2y=d2y))
    assert_array_equal(data.dy[:, 0], dy)
    assert_array_equal(data.d2y[:, 0], d2y)
    whole = functions.from_arrays(arrays(x=np.arange(12)[:, None], dy=None, d2y=None))
    assert whole.x.dtype == np.float64 and whole.dy is None


def test_what_does_not_fit_is_named():
    for content, message in (
        (arrays(x=np.zeros(12)), r"x has shape \(12,\); expected \[N, n\].*x\[:, None\]"),
        (arrays(x=np.zeros((12, 0))), "n >= 1"),
        (arrays(y=np.zeros((11, 2))), "y has 11 samples, but x has 12"),
        (arrays(dy=np.zeros((12, 3, 2))), r"dy has shape \(12, 3, 2\); expected \(12, 2, 3\) to match x"),
        (arrays(d2y=np.zeros((12, 3, 3))), r"d2y has shape \(12, 3, 3\); expected \(12, 2, 3, 3\)"),
        (arrays(y=np.zeros((12, 2), complex)), "y has type complex128; expected real"),
    ):
        with one_line(message):
            functions.from_arrays(content)
    with one_line("noise is -1"):
        published("sin", noise=-1)


def test_a_split_has_every_sample_once():
    data = published("sin", samples=101, noise=0.0)
    train, validation = functions.split(data, seed=1)
    assert len(validation.x) == 10 and sorted([*train.x, *validation.x]) == sorted(data.x)
    assert_allclose(validation.dy[:, 0], np.cos(validation.x))


SINE = ((jnp.ones((1, 1)), jnp.array([-jnp.pi / 2])), (jnp.ones((1, 1)), jnp.zeros(1)))
"""sin x = cos(x - π/2) as a network."""


def test_an_exact_model_has_no_loss_and_a_wrong_one_that_of_its_terms():
    for loss, derivative in (("type1", 1), ("type1", 2), ("type2", 2)):
        grid = published_grid("sin")
        batch = targets(grid, Network(loss=loss, derivative=derivative, precision="f64"))
        assert float(mean_square(partial(residual, SINE, activation=cos), batch)) < 1e-30
        double = (SINE[0], (2 * SINE[1][0], SINE[1][1]))
        read = [grid.y, *([grid.dy] if loss == "type1" else []), *([grid.d2y] if derivative == 2 else [])]
        expected = sum(np.mean(each**2) for each in read)
        assert_allclose(mean_square(partial(residual, double, activation=cos), batch), expected, rtol=1e-12)


def test_a_network_of_standard_units_is_the_same_in_the_users_units():
    data = functions.from_arrays(arrays(x=1e3 + 40 * arrays()["x"], y=1e-3 * arrays()["y"]))
    units = standard_units(data)
    standard = to_units(data, units)
    assert_allclose(standard.x.std(axis=0), 1)
    assert_allclose(standard.y.mean(axis=0), 0, atol=1e-12)
    for sizes in ((3, 4, 2), (3, 2)):
        layers = differential_mlp.init_ensemble(jax.random.key(0), sizes, members=1)
        inner, _ = predict(layers, standard.x, activation=tanh)
        outer, _ = predict(layers_in_own_units(layers, units), data.x, activation=tanh)
        for ours, theirs in zip(to_units(outer, units), inner, strict=True):
            assert_allclose(ours, theirs, rtol=1e-9, atol=1e-10)
    assert (standard_units(data._replace(x=np.ones((12, 3)))).x_size == 1).all()


def test_errors_are_sums_over_components_and_ensembles_average():
    truth = published_grid("cos_sin")
    off = truth._replace(y=truth.y + 0.5, dy=truth.dy + np.array([0.3, 0.4]), d2y=truth.d2y + 1.0)
    assert errors(off, truth) == pytest.approx({"value_mse": 0.25, "gradient_mse": 0.25, "hessian_mse": 4.0})
    assert set(errors(off, truth._replace(d2y=None))) == {"value_mse", "gradient_mse"}
    layers = differential_mlp.init_ensemble(jax.random.key(0), (2, 4, 1), members=3)
    mean, spread = predict(layers, truth.x, activation=tanh)
    alone = [
        predict(jax.tree.map(lambda a, k=k: a[k : k + 1], layers), truth.x, activation=tanh)[0].d2y for k in range(3)
    ]
    assert_allclose(mean.d2y, np.mean(alone, axis=0), atol=1e-12)
    assert_allclose(spread.d2y, np.std(alone, axis=0, ddof=1), atol=1e-12)


def test_members_of_an_ensemble_train_as_if_alone():
    """Adam on the sum of losses moves each member as it would move by itself, on the same batches."""
    sets = functions.split(published("sin", samples=200))
    settings = Network(width=3, members=2, precision="f64", activation="tanh")
    optimiser = published_adam(len(sets.train.x), epochs=4, batch=20)
    together = regression.train(sets, settings, optimiser)
    first = differential_mlp.init_ensemble(jax.random.key(0), (1, 3, 1), members=2)
    assert not np.allclose(*first[0][0])
    given = regression.problem(sets, settings._replace(members=1), together=True)
    alone = fit(given._replace(parameters=jax.tree.map(lambda leaf: leaf[1:], first)), optimiser)
    assert alone.best_step == together.best_step == 36
    for one, both in zip(jax.tree.leaves(alone.parameters), jax.tree.leaves(together.parameters), strict=True):
        assert_allclose(one[0], both[1], rtol=1e-9, atol=1e-12)
