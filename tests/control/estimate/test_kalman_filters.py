"""Filters of linear processes are the Kalman filter, and those of a cart-pole are consistent."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from scipy.stats import chi2

import dln_jax
from dln_jax.control.estimate.kalman import (
    Process,
    belief,
    consistency,
    filtered,
    mechanical,
    predict,
    update,
)
from dln_jax.control.estimate.tuning import from_log, tuned
from dln_jax.data.schema import Trajectories
from dln_jax.scenes.pendulums import cart_pole, pendulum

F = np.array([[1.0, 0.1, 0.0], [-0.2, 0.95, 0.05], [0.0, 0.0, 0.9]])
B, G = np.array([[0.0], [0.1], [0.3]]), np.array([[0.0, 0.02], [0.1, 0.0], [0.0, 0.3]])
H = np.array([[1.0, 0.0, 0.0], [0.5, 0.0, 1.0]])
LINEAR = Process(
    lambda x, u, w: jnp.asarray(F @ x + B @ u + G @ w),
    lambda x: jnp.asarray(H @ x),
    np.array([0.7, 0.4]),
    np.array([0.1, 0.2]),
)
PRIOR = belief([0.3, -0.2, 0.1], [1.0, 2.0, 0.5])


def linear_log(samples, seed=0):
    random = np.random.default_rng(seed)
    x = np.array([0.5, 1.0, 0.0])
    y = []
    u = random.normal(size=(samples, 1))
    for number in range(samples):
        y.append(H @ x + random.normal(size=2) * LINEAR.noise)
        x = F @ x + B @ u[number] + G @ (random.normal(size=2) * LINEAR.disturbance)
    return jnp.asarray(np.stack(y)), jnp.asarray(u)


def textbook(y, u, seen):
    """Means of the Kalman filter in its plain form."""
    x, P = np.asarray(PRIOR.x), np.asarray(PRIOR.W @ PRIOR.W.T)
    Q = G * LINEAR.disturbance**2 @ G.T
    R = np.diag(LINEAR.noise**2)
    means = []
    y, u = np.asarray(y), np.asarray(u)
    for number in range(len(y)):
        rows = np.flatnonzero(seen[number])
        h = H[rows]
        gain = P @ h.T @ np.linalg.inv(h @ P @ h.T + R[np.ix_(rows, rows)]) if len(rows) else np.zeros((3, 0))
        x, P = x + gain @ (y[number][rows] - h @ x), P - gain @ h @ P
        means.append(x)
        x, P = F @ x + B @ u[number], F @ P @ F.T + Q
    return np.stack(means)


def test_filters_of_a_linear_process_are_the_kalman_filter_at_several_rates():
    y, u = linear_log(40)
    seen = np.stack([np.arange(40) % 2 == 0, np.arange(40) % 5 == 0], axis=1)
    expected = textbook(y, u, seen)
    for process in (LINEAR, LINEAR._replace(unscented=True)):
        means = jax.jit(lambda y, process=process: filtered(process, PRIOR, y, u, seen)[0])
        np.testing.assert_allclose(means(y), expected, rtol=0, atol=1e-12)
        # A channel that is not seen may hold anything.
        np.testing.assert_array_equal(means(np.where(seen, y, np.nan)), means(y))


def test_the_covariance_stays_positive_with_encoders_a_million_times_better_than_the_prior():
    sharp = LINEAR._replace(noise=np.array([1e-9, 1e-9]))
    now = belief(np.zeros(3), 1e4)
    for _ in range(5):
        now = predict(sharp, update(sharp, now, jnp.zeros(2))[0], jnp.zeros(1))
        assert np.linalg.eigvalsh(now.W @ now.W.T).min() > -1e-16


def test_errors_on_a_cart_pole_are_as_large_as_the_covariance_says():
    """Along 60 motions near hanging with random torques, from draws of the belief."""
    scene = cart_pole()
    samples = 80
    model, actuation = dln_jax.dynamics(scene.closed_form), np.array(scene.needs.actuation)
    process = mechanical(model, actuation, rate=200.0, band=[0.5, 0.02], encoder_noise=[1e-3, 2e-3])
    prior = belief([0.0, np.pi, 0.0, 0.0], [0.02, 0.1, 0.1, 0.3])

    def run(key):
        of_start, of_w, of_v = jax.random.split(key, 3)
        x = prior.x + prior.W @ jax.random.normal(of_start, (4,))
        w = jnp.asarray(process.disturbance) * jax.random.normal(of_w, (samples, 2))
        v = jnp.asarray(process.noise) * jax.random.normal(of_v, (samples, 2))
        u = 2.0 * jnp.sin(0.05 * jnp.arange(samples))[:, None]
        _, x = jax.lax.scan(lambda x, row: (process.step(x, *row), x), x, (u, w))
        return x, x[:, :2] + v, u

    logs = jax.jit(jax.vmap(run))(jax.random.split(jax.random.key(0), 60))
    for kind in (process, process._replace(unscented=True)):

        def sample(now, row, kind=kind):
            x, y, u = row
            now, innovation = update(kind, now, y)
            off = jnp.linalg.solve(now.W, x - now.x)
            return predict(kind, now, u), (off @ off, consistency(innovation))

        squared, ratio = jax.jit(jax.vmap(lambda *log, sample=sample: jax.lax.scan(sample, prior, log)[1]))(*logs)
        # Runs are independent, samples of one are not: a time's sum over runs has 4 x 60 degrees of freedom.
        low, high = chi2.ppf([1e-4, 1 - 1e-4], 240)
        sums = np.asarray(squared)[:, ::20].sum(axis=0)
        assert ((sums > low) & (sums < high)).all()
        low, high = chi2.ppf([1e-4, 1 - 1e-4], ratio.size * 2) / (ratio.size * 2)
        assert low < float(ratio.mean()) < high


@pytest.mark.slow
def test_late_samples_do_not_look_like_noise_if_the_log_has_their_times():
    """A log at 200 Hz with a band of 0.1 N m and an encoder of 1 mrad, whose resolution is the noise."""
    model = dln_jax.dynamics(pendulum().closed_form)
    resolution = 1e-3
    process = mechanical(model, rate=200.0, band=[0.1], encoder_step=resolution)
    random = np.random.default_rng(0)
    x = jnp.array([2.5, 0.0])
    q = []
    late = np.random.default_rng(1).uniform(0, 4e-3, 400)
    tau = 0.5 * np.sin(0.07 * np.arange(400))[:, None]
    step = jax.jit(process.step)
    for number in range(400):
        q.append(resolution * np.round((x[:1] + late[number] * x[1:]) / resolution))
        x = step(x, tau[number], 0.1 * random.normal(size=1))
    absent = np.full((400, 1), np.nan)
    even = np.arange(400) / 200.0
    log = Trajectories(even + late, np.stack(q), absent, absent, tau, np.zeros(400, int), np.array(["a"]))
    of_times, of_even_times = (from_log(model, one) for one in (log, log._replace(t=even)))
    assert resolution / np.sqrt(12) * 0.999 < of_times.noise[0] < 5e-4 and of_even_times.noise[0] > 2e-3
    assert 0.03 < of_times.disturbance[0] < 0.3


@pytest.mark.slow
def test_disturbance_is_found_from_logs_of_several_lengths():
    wrong = LINEAR._replace(disturbance=np.array([0.2, 0.1]))
    logs = [(PRIOR, *linear_log(samples, seed)) for seed, samples in enumerate((400, 100))]
    np.testing.assert_allclose(tuned(wrong, logs).disturbance, LINEAR.disturbance, rtol=0.25)


def test_curvature_of_a_measurement_counts_as_noise():
    """For y = a² with a ~ N(0, s²) and an unseen b, the points ±√2 s and 0 have the mean s² and the variance s⁴."""
    process = Process(lambda x, u, w: x, lambda x: x[:1] ** 2, np.zeros(0), 0.1, unscented=True)
    _, innovation = update(process, belief(jnp.zeros(2), jnp.array([0.5, 1.0])), jnp.array([0.25]))
    assert innovation.residual == pytest.approx(0.0) and innovation.variance == pytest.approx(0.1**2 + 0.5**4)


def test_processes_without_noise_are_refused():
    with one_line("neither encoder_step nor encoder_noise"):
        mechanical(dln_jax.dynamics(pendulum().closed_form), rate=100.0, band=[0.1])
    with one_line("deviation is"):
        belief(np.zeros(2), [0.0, 1.0])
