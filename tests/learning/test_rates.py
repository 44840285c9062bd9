"""Phase models: the energy law, the polynomial's exactness, the metrics of predicted motions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from motions import quick_motion

from dln_jax.data.splits import hold_out
from dln_jax.learning.matching import match_linear, rates_problem
from dln_jax.mechanics.equations import flow
from dln_jax.mechanics.hamiltonian import HamiltonianSystem
from dln_jax.metrics import phase_space as phase_metrics
from dln_jax.models.baselines import make_phase_network
from dln_jax.models.hamiltonian import make_dissipative, make_polynomial_hamiltonian, make_separable_hamiltonian
from dln_jax.models.model import Model
from dln_jax.scenes.datasets import hamiltonian_tasks
from dln_jax.types import Needs
from tests.models.random_parameters import drawn

NEEDS = Needs(joints=("revolute", "prismatic"), friction=True)
SMALL = {"width": 4, "depth": 1, "dtype": jnp.float64}
FRICTION = {"friction_width": 4, "dtype": jnp.float64}


@pytest.fixture(scope="module")
def swing():
    """The pendulum without noise."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hamiltonian_tasks, "reference_motion", quick_motion)
        return hamiltonian_tasks.pendulum(0, trajectories=6, noise=0.0)


def test_friction_takes_energy_and_never_gives_it():
    """dH/dt = -qdᵀ dD/dqd = -2 D <= 0, for random parameters and states."""
    model = make_dissipative(lambda needs: make_separable_hamiltonian(needs, **SMALL), NEEDS, **FRICTION)
    energies = model.energies(drawn(model, size=2))

    @jax.jit
    @jax.vmap
    def ask(q, p):
        field = flow(energies)
        rates = field.rates(q, p)
        friction = jax.grad(energies.dissipation, argnums=1)(q, rates[0])
        rate = jax.jvp(field.energy, (q, p), rates)[1]
        return rate, energies.dissipation(q, rates[0]), rates[0] @ friction

    rate, loss, power = ask(*(3 * np.random.default_rng(0).normal(size=(2, 40, 2))))
    assert (loss > 0).all() and float(loss.max()) > 1e-3
    np.testing.assert_allclose(rate, -2 * loss, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(power, 2 * loss, rtol=1e-9)


def test_the_polynomial_recovers_the_pendulum(swing):
    """H = 3 (1 - cos q) + p² has the coefficients -3 and 1, and all others vanish."""
    model = make_polynomial_hamiltonian(Needs(joints=("revolute",)), degree=2, dtype=jnp.float64)
    training, errors = match_linear(model, swing.train.data, validation=swing.test.data)
    coefficients = np.asarray(training.parameters)
    order = np.argsort(-np.abs(coefficients))
    np.testing.assert_allclose(coefficients[order[:2]], [-3, 1], rtol=1e-9)
    np.testing.assert_allclose(coefficients[order[2:]], 0, atol=1e-9)
    assert len(errors) == len(swing.test.data.t) and errors.max() < 1e-18
    # For d = 1 and degree 2: 1, cos, sin, cos 2q, sin 2q times 1, p, p², without the constant and higher degrees.
    assert len(coefficients) == 2 + 2 + 1 + 1 + 2


def test_metrics_by_hand_and_motions_that_end():
    """Energy q² + p² of given states; a field that reaches infinity in finite time has infinite errors."""
    truth = phase_metrics.Motions(np.array([0.0, 1.0]), np.zeros((2, 2, 1)), np.ones((2, 2, 1)))
    off = truth._replace(p=truth.p + np.array([[[0.0], [1.0]], [[0.0], [0.0]]]))
    found = phase_metrics.motion_errors([off], [truth], lambda q, p: jnp.sum(q**2 + p**2))
    # Energies are 1 and 4 against 1: errors 0, 9 and 0, 0.
    assert found["energy_mse"] == found["energy_mse_median"] == pytest.approx(2.25)
    assert found["energy_mse_standard_error"] == pytest.approx(4.5 / 2)
    assert found["rollout_mse"] == pytest.approx(1 / 8)
    explosive = Model(None, lambda parameters: HamiltonianSystem(lambda q, p: jnp.sum(q**2 * p)))
    moved = phase_metrics.predict(explosive, 0.0, np.ones((1, 1)), np.zeros((1, 1)), np.array([0.0, 2.0]))
    assert np.isinf(phase_metrics.state_errors(moved, phase_metrics.Motions(*(each[:1] for each in truth)))).all()


def test_mistakes_are_named(swing):
    data, needs = swing.train.data, Needs(joints=("revolute",))
    model = make_phase_network(needs, **SMALL)
    for call, message in [
        (lambda: rates_problem(model, data, data, most_samples=0), "most_samples is 0"),
        (lambda: rates_problem(model, data, data, seed=-1), "seed is -1"),
        (
            lambda: rates_problem(model, data._replace(p=None), data),
            "the data have no p, but this fit needs it",
        ),
        (lambda: hold_out(data, 1.5, 0), "validation_share is 1.5"),
        (lambda: hold_out(data._replace(trajectory=0 * data.trajectory), 0.1, 0), "there are 1 trajectories"),
        (lambda: make_polynomial_hamiltonian(needs, degree=1), "degree is 1"),
        (lambda: make_polynomial_hamiltonian(NEEDS), "conserves energy"),
        (lambda: make_polynomial_hamiltonian(Needs(joints=("prismatic",) * 6), degree=9), "lower the degree"),
        (lambda: make_phase_network(needs, depth=0), "depth is 0"),
    ]:
        with one_line(message):
            call()
