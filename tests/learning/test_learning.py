"""The fit loop on a problem with a known answer, its stops, and its continuation bit for bit."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from dln_jax.data.splits import split
from dln_jax.datasets import generators
from dln_jax.learning.dynamics_fit import Settings, train
from dln_jax.learning.engine import fit
from dln_jax.learning.engine.optimisers import adamw
from dln_jax.learning.engine.runs import Stop, fingerprint
from dln_jax.learning.objectives import TORQUE, arrays, mean_loss, torque_scale
from dln_jax.models.delan import make_delan
from dln_jax.scenes.cart_pole import cart_pole
from dln_jax.scenes.pendulum import pendulum
from dln_jax.scenes.two_link_arm import two_link_arm
from dln_jax.types import InputError, Needs

X = jnp.linspace(-1, 1, 50)
LINE = (X, 3 * X - 1)


def line_fit(optimiser, *, steps=300, batch=16, validate=None, **keywords):
    """Least squares of a line, whose answer is slope 3 and offset -1."""

    def loss(parameters, batch):
        x, y = batch
        return jnp.mean((parameters[0] * x + parameters[1] - y) ** 2)

    def score(parameters):
        value = loss(parameters, LINE)
        return (validate(parameters) if validate else value), value

    return fit.make_fit(loss, optimiser, LINE, steps=steps, batch=batch, score=score, **keywords)


def run(prepared, state=None, patience=10**6, until=None):
    records, states = [], []

    def on_dispatch(state, record):
        records.append(record)
        states.append(jax.tree.map(np.asarray, state))
        if until is not None and record.step >= until:
            raise KeyboardInterrupt

    if state is None:
        state = prepared.init(jnp.zeros(2), 0)
    try:
        state, stop = fit.run(prepared, state, patience=patience, on_dispatch=on_dispatch)
    except KeyboardInterrupt:
        stop = None
    return state, stop, records, states


def test_it_finds_the_line_and_counts_whole_epochs():
    state, stop, records, _ = run(line_fit(optax.adam(0.1), steps=301, steps_per_dispatch=100))
    np.testing.assert_allclose(state.best_parameters, [3.0, -1.0], atol=1e-3)
    assert stop == Stop("finished", 303)  # 3 batches of 16 in 50 samples
    assert [record.step for record in records] == [102, 204, 303]
    assert float(state.best_validation) == pytest.approx(min(record.validation for record in records), rel=1e-5)


def test_the_best_parameters_are_those_of_the_best_validation():
    # Validation prefers a point that the path passes on its way to the answer.
    prepared = line_fit(optax.sgd(0.05), validate=lambda parameters: jnp.abs(parameters[0] - 1.5), steps_per_dispatch=3)
    state, _, records, states = run(prepared)
    best = int(np.argmin([record.validation for record in records]))
    assert 0 < best < len(records) - 1
    np.testing.assert_array_equal(state.best_parameters, states[best].parameters)
    assert int(state.best_step) == records[best].step


def test_it_stops_early_without_improvement():
    prepared = line_fit(optax.sgd(0.0), steps=3000, steps_per_dispatch=30)
    _, stop, records, _ = run(prepared, patience=100)
    assert stop.reason == "no improvement" and 130 <= stop.step < 200
    assert len(records) == stop.step // 30


def test_a_loss_that_stops_being_finite_ends_at_the_last_good_parameters():
    def explode_after(steps):
        return optax.sgd(lambda step: jnp.where(step < steps, 0.01, 1e200))

    for explosion, dispatches in ((50, 1), (59, 1), (60, 2)):
        state, stop, records, states = run(line_fit(explode_after(explosion), steps_per_dispatch=30))
        assert stop.reason == "not finite" and explosion < stop.step <= explosion + 3
        assert len(records) == dispatches
        np.testing.assert_array_equal(state.parameters, states[-1].parameters)
        assert int(state.step) == records[-1].step == 30 * dispatches
        assert np.isfinite(state.best_parameters).all()


def test_a_continued_run_equals_an_unbroken_one_bit_for_bit():
    prepared = line_fit(adamw(steps=300), steps_per_dispatch=50)
    unbroken, *_ = run(prepared)
    *_, states = run(prepared, until=150)
    continued, *_ = run(prepared, jax.tree.map(jnp.asarray, states[-1]))
    for one, other in zip(jax.tree.leaves(continued), jax.tree.leaves(unbroken), strict=True):
        np.testing.assert_array_equal(one, other)


def test_dispatches_of_any_length_are_one_compilation():
    prepared = line_fit(optax.adam(0.1), steps=100, steps_per_dispatch=30)
    run(prepared)  # 30, 30, 30 and what is left
    assert prepared.dispatch._cache_size() == 1


@pytest.mark.parametrize(("batch", "whole"), [(25, True), (16, False)])
def test_every_epoch_is_another_permutation_without_repetition(batch, whole):
    """At learning rate zero an epoch of all samples has the loss of the set; one that leaves two out, another."""
    prepared = line_fit(optax.sgd(0.0), steps=60, steps_per_dispatch=1, batch=batch)
    *_, records, _ = run(prepared)
    losses = np.array([record.loss for record in records])
    full = float(jnp.mean((3 * X - 1) ** 2))
    assert len(losses) >= 20
    if whole:
        np.testing.assert_allclose(losses, full, rtol=1e-12)
    else:
        assert len(set(losses)) == len(losses)


def test_the_order_of_many_samples_is_not_that_of_the_file():
    """Two samples that meet in a batch of two are as often in the file's order as not."""
    samples = 2**16
    prepared = fit.make_fit(
        lambda parameters, batch: jnp.where(batch[0] < batch[1], parameters, 0.0),
        optax.sgd(1.0),  # each pair in order takes 1 from the parameter
        jnp.arange(samples),
        steps=samples // 2,
        batch=2,
        score=lambda parameters: (parameters, parameters),
    )
    state, _ = prepared.dispatch(prepared.init(jnp.zeros(()), 0), 1)
    in_order = -float(state.parameters)
    assert abs(in_order - samples / 4) < 5 * np.sqrt(samples / 8)  # standard deviations


def test_torque_scale_never_divides_by_zero():
    data = generators.uniform(cart_pole(), samples=100)
    scale = torque_scale(data)
    assert scale[0] == pytest.approx(data.tau[:, 0].std()) and scale[1] == pytest.approx(scale[0])
    constant = data._replace(tau=np.full_like(data.tau, 7.3))
    with pytest.raises(InputError, match="tau is constant in every training sample"):
        torque_scale(constant)


def test_the_textbook_has_no_torque_residual():
    data = generators.uniform(two_link_arm(), samples=100)
    scale = torque_scale(data)
    assert mean_loss(TORQUE, two_link_arm().energies, arrays(TORQUE, data, jnp.float64), scale) < 1e-24


@pytest.fixture(scope="module")
def pendulum_sets():
    return split(generators.uniform(pendulum(friction=0.5), samples=300, rate_bound=3.0, acceleration_bound=5.0))


@pytest.mark.parametrize("friction", [True, False])
def test_training_learns_a_plant_and_misfit_shows_what_the_model_lacks(pendulum_sets, friction):
    needs = Needs(("revolute",), friction=friction)
    model = make_delan(needs, width=16, depth=1, dtype=jnp.float64)
    settings = Settings(steps=1500, batch=64, learning_rate=1e-2, precision="f64")
    training = train(model, pendulum_sets, settings)
    # The friction torque 0.5 qd, uniform within ±3 /s, has a mean square of 0.75.
    validation = min(at.validation for at in training.history)
    assert validation < 1e-2 if friction else 0.4 < validation < 1.2
    assert training.stop.reason == "finished" and training.train_seconds > 0


@pytest.mark.parametrize("wrong", [{"steps": 0}, {"batch": -1}, {"learning_rate": 0.0}, {"precision": "f16"}], ids=str)
def test_settings_out_of_range_are_refused(pendulum_sets, wrong):
    model = make_delan(pendulum().needs, width=2, depth=1)
    with pytest.raises(InputError, match=next(iter(wrong))):
        train(model, pendulum_sets, Settings(**wrong))


def test_the_fingerprint_follows_the_numbers(pendulum_sets):
    tau = pendulum_sets.test.tau
    assert fingerprint([tau, None]) == fingerprint([tau.copy()]) != fingerprint([tau + 1e-15])
