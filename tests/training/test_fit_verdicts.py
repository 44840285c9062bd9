"""Every fit of dynamics gets a verdict: by torques, accelerations, mass matrices and rollouts."""

import jax.numpy as jnp
import numpy as np

from dln_jax import LagrangianSystem, Needs
from dln_jax.data.log import Log, Parts
from dln_jax.data.schema import from_arrays
from dln_jax.data.splits import Split, select
from dln_jax.learning.fit import Fit
from dln_jax.learning.objectives import CANONICAL, STATED
from dln_jax.metrics.motions import Motion
from dln_jax.models.model import Model
from dln_jax.runs.verdict import verdict_of as verdict_and_metrics

N = 300
OBJECTIVES = {**STATED, "momenta": CANONICAL}
Q = np.linspace(-0.06, 0.94, N)[np.random.default_rng(0).permutation(N)][:, None]
QD, QDD = np.random.default_rng(1).normal(size=(2, N, 1))
# Inertia q: T = q qd² / 2, negative at 6 % of the states.
TAU = Q * QDD + QD**2 / 2
TIMES = {"t": np.tile(0.01 * np.arange(N // 3), 3), "trajectory": np.repeat([0, 1, 2], N // 3)}
DATA = from_arrays({**TIMES, "q": Q, "qd": QD, "qdd": QDD, "tau": TAU})
SETS = Split(*(select(DATA, [index]) for index in range(3)))
ANSWERS = {key: np.concatenate([getattr(SETS.test, key), getattr(SETS.validation, key)]) for key in ("tau", "qdd")}


def verdict_of(inertia=lambda q: jnp.ones(()), *, objective="inverse", motions=(), causes=(), **changes):
    """The verdict on a model with this inertia, whose answers are exact but for the changes."""
    log = Log("log", DATA, Needs(joints=("revolute",)), "the test", faults=causes)
    system = LagrangianSystem(lambda q, qd: inertia(q[0]) * qd[0] ** 2 / 2)
    model = Model(lambda key: (), lambda parameters: system)
    description = {"name": "black-box-delan", "precision": "f64"}
    fit = Fit(model, (), description, objective=OBJECTIVES[objective])
    verdict, metrics = verdict_and_metrics(fit, Parts(SETS), log, ANSWERS | changes, list(motions))
    assert metrics["verdict"] == verdict.number and {"test_nmse", "validation_nmse"} <= set(metrics)
    return verdict


def test_exact_fit_is_good_and_wrong_torques_are_refused_by_every_objective():
    for objective in OBJECTIVES:
        assert verdict_of(objective=objective).level == "good"
        verdict = verdict_of(objective=objective, tau=8 * ANSWERS["tau"], causes=("accelerations are noise",))
        assert verdict.level == "refused" and "in the log, accelerations are noise" in verdict.reason
        assert "the torque of joint 1 is predicted no better than by a constant" in verdict.line


def test_accelerations_are_judged_if_the_model_is_fitted_to_them():
    wrong = ANSWERS["qdd"] + 0.4 * ANSWERS["qdd"].std()
    for objective, level in (("forward", "doubtful"), ("both", "doubtful"), ("inverse", "good")):
        verdict = verdict_of(objective=objective, qdd=wrong)
        assert verdict.level == level
        assert ("5% of the acceleration of joint 1 is unexplained" in verdict.reason) == (level == "doubtful")


def test_mass_matrix_that_is_indefinite_at_some_states_is_doubtful_and_at_all_states_refused():
    some = verdict_of(lambda q: q)
    assert some.level == "doubtful" and "not positive definite at 6.0% of the states" in some.reason and some.remedy
    assert verdict_of(lambda q: -jnp.ones(())).level == "refused"


def test_rollouts_that_are_not_finite_are_doubtful():
    for value, level in ((0.0, "good"), (np.inf, "doubtful"), (np.nan, "doubtful")):
        motions = [Motion(np.full((5, 1), each), np.zeros((5, 1)), np.zeros(5)) for each in (0.0, value)]
        verdict = verdict_of(motions=motions)
        assert verdict.level == level
        assert ("1 of 2 rollouts of test motions are not finite" in verdict.reason) == (level == "doubtful")
