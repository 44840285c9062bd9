"""The loop of all trainings on problems with known answers: its stops, its stages, its continuation bit for bit."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from calls import one_line

from dln_jax.learning.engine import optimisers
from dln_jax.learning.engine.checkpoint import Checkpoint, identity
from dln_jax.learning.engine.fit import ALL, SOME, fit
from dln_jax.learning.engine.optimisers import Adam, GaussNewton
from dln_jax.learning.engine.problem import Problem, Stop, loss_of
from dln_jax.learning.objectives import torque_scale
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.pendulums import cart_pole
from dln_jax.solvers import levenberg_marquardt

X = jnp.linspace(-1, 1, 50)
LINE = (X, 3 * X - 1)


def line(validate=None, parameters=(0.0, 0.0), seed=0):
    """Least squares of a line, whose answer is slope 3 and offset -1."""

    def residual(parameters, x, y):
        return parameters[0] * x + parameters[1] - y

    def score(parameters):
        value = jnp.mean(residual(parameters, *LINE) ** 2)
        return (validate(parameters) if validate else value), value

    return Problem(residual, jnp.asarray(parameters), LINE, score, seed)


def bumps(parameters, seed=0):
    """A sum of tanh, for Gauss-Newton, on random places; the score prefers what the path only passes."""
    x = jax.random.uniform(jax.random.key(1), (64,), minval=-2.0, maxval=2.0)

    def residual(parameters, x, y):
        heights, places = parameters
        return heights @ jnp.tanh(x - places) - y

    def score(parameters):
        return abs(parameters[0][0] - 1.2), jnp.sum(parameters[1])

    return Problem(residual, parameters, (x, jnp.sin(2 * x)), score, seed)


BUMPS = (jnp.array([0.5, 1.0, -0.7]), jnp.array([-1.0, 0.1, 0.8]))


@pytest.fixture
def takes(monkeypatch):
    """Another transformation in place of AdamW."""
    return lambda optimiser: monkeypatch.setattr(optimisers, "transformation", lambda adam: optimiser)


def test_it_finds_the_line_and_counts_whole_epochs(takes):
    takes(optax.adam(0.1))
    training = fit(line(), Adam(steps=301, batch=16, steps_per_dispatch=100))
    np.testing.assert_allclose(training.parameters, [3.0, -1.0], atol=1e-3)
    assert training.stop == Stop("finished", 303)  # 3 batches of 16 in 50 samples
    assert [at.step for at in training.history] == [102, 204, 303]
    assert training.train_seconds > 0 and training.compile_seconds > 0


@pytest.mark.parametrize("kind", ["adam", "newton"])
def test_the_best_parameters_are_those_of_the_best_validation(takes, kind):
    """Validation prefers a point that the path passes on its way to the answer."""
    takes(optax.sgd(0.05))
    if kind == "adam":
        training = fit(line(lambda parameters: jnp.abs(parameters[0] - 1.5)), Adam(300, 16, steps_per_dispatch=3))
        value = abs(training.parameters[0] - 1.5)
    else:
        training = fit(bumps(BUMPS), GaussNewton(14, steps_per_dispatch=1))
        value = abs(training.parameters[0][0] - 1.2)
    validations = [at.validation for at in training.history]
    best = int(np.argmin(validations))
    assert best < len(validations) - 1 and training.best_step == training.history[best].step
    assert training.validation == validations[best] == pytest.approx(float(value), rel=1e-12)


def test_it_stops_early_without_improvement(takes):
    takes(optax.sgd(0.0))
    training = fit(line(), Adam(steps=3000, batch=16, steps_per_dispatch=30, patience=100))
    assert training.stop.reason == "no improvement" and 130 <= training.stop.step < 200
    assert len(training.history) == training.stop.step // 30


@pytest.mark.parametrize(("explosion", "dispatches"), [(59, 1), (60, 2)])
def test_a_loss_that_stops_being_finite_ends_at_the_last_good_parameters(takes, explosion, dispatches):
    takes(optax.sgd(lambda step: jnp.where(step < explosion, 0.01, 1e200)))
    training = fit(line(), Adam(steps=300, batch=16, steps_per_dispatch=30))
    assert training.stop.reason == "not finite" and explosion < training.stop.step <= explosion + 3
    assert [at.step for at in training.history] == [30 * (number + 1) for number in range(dispatches)]
    takes(optax.sgd(0.01))
    good = fit(line(), Adam(steps=30 * dispatches, batch=16, steps_per_dispatch=30))
    np.testing.assert_array_equal(training.parameters, good.parameters)


@pytest.mark.parametrize("optimiser", [Adam(), GaussNewton()])
def test_a_start_that_is_not_finite_is_an_error_or_a_result(optimiser):
    given = line()
    given = given._replace(arrays=(X, LINE[1].at[7].set(jnp.nan)))
    with one_line("not finite before training"):
        fit(given, optimiser)
    training = fit(given, optimiser, must_start=False)
    assert training.stop.reason == "not finite" and not training.history
    np.testing.assert_array_equal(training.parameters, 0)


class Interruption(Exception):
    pass


def broken_and_continued(given, optimiser, folder, dispatches):
    """The training of a run that ends after some dispatches, and is continued."""

    def break_(at):
        seen.append(at)
        if len(seen) == dispatches:
            raise Interruption

    seen, checkpoint = [], Checkpoint(folder, identity(optimiser, given.arrays))
    with pytest.raises(Interruption):
        fit(given, optimiser, checkpoint=checkpoint, report=break_)
    return fit(given, optimiser, checkpoint=checkpoint._replace(resume=True))


SEVERAL = jax.tree.map(lambda leaf: jnp.stack([leaf, 1.3 * leaf, -leaf]), BUMPS)
NEWTON = GaussNewton(8, coarse_steps=5, coarse_samples=20, steps_per_dispatch=2)
TRAINED = {
    "adam, seeds": (
        line(parameters=((0.0, 0.0), (1.0, 2.0)), seed=jnp.arange(2)),
        Adam(90, 16, steps_per_dispatch=30),
    ),
    "newton": (bumps(BUMPS), NEWTON),
    "newton, seeds": (bumps(SEVERAL, jnp.arange(3)), NEWTON),
}


@functools.cache
def unbroken(name):
    return fit(*TRAINED[name])


@pytest.mark.parametrize(
    ("name", "dispatches"),
    [
        ("adam, seeds", 2),
        pytest.param("newton", 3, id="newton, between the stages"),
        ("newton, seeds", 4),
    ],
)
def test_a_continued_run_equals_an_unbroken_one_bit_for_bit(tmp_path, name, dispatches):
    whole, continued = unbroken(name), broken_and_continued(*TRAINED[name], tmp_path, dispatches)
    assert continued.stop == whole.stop and len(continued.history) == len(whole.history) > dispatches
    for one, other in zip(continued.history, whole.history, strict=True):
        np.testing.assert_equal(one._replace(seconds=0.0), other._replace(seconds=0.0))
    np.testing.assert_array_equal(continued.best_step, whole.best_step)
    for one, other in zip(jax.tree.leaves(continued.parameters), jax.tree.leaves(whole.parameters), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_run_of_other_settings_or_data_is_not_continued(tmp_path):
    optimiser = GaussNewton(3, steps_per_dispatch=1)
    known = identity(optimiser, LINE)
    fit(line(), optimiser, checkpoint=Checkpoint(tmp_path, known))
    for other, named in (
        (identity(optimiser._replace(steps=4), LINE), "other settings"),
        (identity(Adam(), LINE), "other settings"),
        (identity(optimiser, LINE, seed=3), "other settings"),
        (identity(optimiser, (X,)), "other data"),
    ):
        with one_line(named):
            fit(line(), optimiser, checkpoint=Checkpoint(tmp_path, other, resume=True))
    finished = fit(line(), optimiser, checkpoint=Checkpoint(tmp_path, known, resume=True))
    assert finished.stop.reason == "finished" and finished.compile_seconds == 0


@pytest.mark.parametrize("name", ["newton, seeds", "adam, seeds"])
def test_seeds_in_one_program_equal_single_runs(name):
    together, (given, optimiser) = unbroken(name), TRAINED[name]
    second = jax.tree.map(lambda leaf: leaf[1], given.parameters)
    alone = fit(given._replace(parameters=second, seed=1), optimiser)
    assert together.validation[1] == pytest.approx(alone.validation, rel=1e-6)
    assert together.best_step[1] == alone.best_step
    if name == "newton, seeds":
        assert [at.stage for at in together.history] == 3 * [SOME] + 4 * [ALL]
        assert [at.step for at in together.history] == [2, 4, 5, 7, 9, 11, 13]


def test_the_best_of_some_samples_starts_the_stage_on_all_and_a_target_ends_it(monkeypatch):
    started = []
    solver = levenberg_marquardt.init
    monkeypatch.setattr(levenberg_marquardt, "init", lambda x: started.append(x) or solver(x))
    optimiser = NEWTON._replace(steps_per_dispatch=1)
    training = fit(bumps(BUMPS), optimiser)
    some = [at for at in training.history if at.stage == SOME]
    best = min(some, key=lambda at: at.validation)
    assert best is not some[-1] and abs(float(started[1][0][0]) - 1.2) == pytest.approx(best.validation, rel=1e-12)
    few = fit(bumps(BUMPS), optimiser._replace(coarse_samples=40))
    assert {at.stage for at in few.history} == {""}
    validations = np.minimum.accumulate([at.validation for at in training.history])
    for place in (1, 6):
        reached = fit(bumps(BUMPS), optimiser._replace(target=float(validations[place])))
        first = int(np.argmax(validations <= validations[place]))
        assert reached.stop == Stop("finished", first + 1) and len(reached.history) == first + 1


def test_time_ends_a_run_between_dispatches():
    for given, optimiser in ((bumps(BUMPS), NEWTON), (line(), Adam(steps=300, batch=16, steps_per_dispatch=30))):
        late = fit(given, optimiser, seconds=1e-6)
        assert late.stop == Stop("time", late.history[0].step) and len(late.history) == 1


def test_every_epoch_is_another_permutation_without_repetition(takes):
    """At learning rate zero an epoch of all samples has the loss of the set; one that leaves two out, another."""
    takes(optax.sgd(0.0))
    whole, part = (
        np.array([at.loss for at in fit(line(), Adam(steps=60, batch=batch, steps_per_dispatch=1)).history])
        for batch in (25, 16)
    )
    assert len(part) >= 20
    np.testing.assert_allclose(whole, float(jnp.mean(LINE[1] ** 2)), rtol=1e-12)
    assert len(set(part)) == len(part)


def test_the_order_of_many_samples_is_not_that_of_the_file(takes):
    """Two samples that meet in a batch of two are as often in the file's order as not."""
    samples = 2**16
    takes(optax.sgd(1.0))  # each pair in order takes 1 from the parameter
    given = Problem(
        residual=None,
        parameters=jnp.zeros(()),
        arrays=(jnp.arange(samples),),
        score=lambda parameters: (parameters, parameters),
        loss=lambda parameters, batch: jnp.where(batch[0][0] < batch[0][1], parameters, 0.0),
    )
    in_order = -float(fit(given, Adam(steps=samples // 2, batch=2, steps_per_dispatch=samples // 2)).parameters)
    assert abs(in_order - samples / 4) < 5 * np.sqrt(samples / 8)  # standard deviations


def test_adam_is_adamw():
    """Step by step, at a constant rate: weights decay apart from the moments of the gradient."""
    start, rule = jnp.array([1.0, 2.0]), optax.adamw(0.1, b2=0.99, weight_decay=0.3)
    loss = loss_of(line())
    parameters, state = start, rule.init(start)
    settings = {"learning_rate": 0.1, "weight_decay": 0.3, "warm_up_share": 0, "final_share": 1}
    training = fit(line(parameters=start), Adam(5, batch=50, steps_per_dispatch=1, **settings))
    update, slope = jax.jit(rule.update), jax.jit(jax.grad(loss))
    for at in training.history:
        change, state = update(slope(parameters, LINE), state, parameters)
        parameters += change
        assert at.validation == pytest.approx(float(loss(parameters, LINE)), rel=1e-12)


def test_torque_scale_never_divides_by_zero():
    data = generators.uniform(cart_pole(), samples=100)
    scale = torque_scale(data)
    assert scale[0] == pytest.approx(data.tau[:, 0].std()) and scale[1] == pytest.approx(scale[0])
    with one_line("tau is constant in all training samples"):
        torque_scale(data._replace(tau=np.full_like(data.tau, 7.3)))


def test_settings_out_of_range_and_what_gauss_newton_does_not_take_are_refused():
    free = line()._replace(residual=None)
    for given, optimiser, named in [
        (line(), Adam(steps=0), "steps"),
        (line(), Adam(learning_rate=0.0), "learning_rate"),
        (line(), Adam(weight_decay=-1.0), "weight_decay"),
        (line(), GaussNewton(steps_per_dispatch=0), "steps_per_dispatch"),
        (free, GaussNewton(), "needs residuals"),
        (free, Adam(), "neither a residual nor a loss"),
        (line()._replace(parameters=jnp.zeros(2, jnp.float32)), GaussNewton(), "parameters are float32"),
    ]:
        with one_line(named):
            fit(given, optimiser)
    with one_line("seconds is 0"):
        fit(line(), Adam(), seconds=0)
