"""Designed motions show parameters better than random ones within the same limits, and keep the limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from planar_arm import ARM as LEVEL

from dln_jax.identification.excitation.design import (
    CRITERIA,
    FINER,
    as_trajectories,
    design_set,
    error_ratio,
    functions_at,
    make_designer,
    random_designs,
    states,
    together,
)
from dln_jax.identification.excitation.limits import MotionLimits, heights_above, scale_limits, worst
from dln_jax.identification.excitation.task import (
    independent_columns,
    linear_force,
    make_task,
    require_sampling,
    sample,
)
from dln_jax.learning.linear import fit_linear, linearised
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees.frames import world_frames
from dln_jax.models.trees import make_rigid_tree
from dln_jax.models.trigonometric import make_planar_chain
from dln_jax.types import Needs
from tests.calls import one_line
from tests.models.random_parameters import drawn

UPRIGHT = np.array([[[1, 0, 0], [0, 0, 1], [0, -1, 0]], np.eye(3)])
# Both axes level, so that the arm swings in a vertical plane.
ARM = LEVEL._replace(rotations=UPRIGHT, gravity=np.array([0, 0, -9.81]))
LIMITS = MotionLimits(
    position=np.array([[-2.0, 1.0], [-2.5, 2.5]]),
    velocity=np.array([2.0, 3.0]),
    acceleration=np.array([8.0, 12.0]),
    force=np.array([[-22.0, 22.0], [-np.inf, np.inf]]),
)
MODEL = make_rigid_tree(ARM, friction=True, velocity_scale=0.1)
PARAMETERS = MODEL.init(jax.random.key(0))._replace(viscous=np.array([0.5, 0.3]), coulomb=np.array([0.8, 0.4]))


@pytest.fixture(scope="module")
def task():
    heights = heights_above(ARM, -0.1)
    return make_task(MODEL, PARAMETERS, LIMITS, period=6.0, harmonics=3, clearance=heights, noise=[0.2, 0.1])


@pytest.fixture(scope="module")
def candidates(task):
    return random_designs(task, 8, seed=1)


@pytest.fixture(scope="module")
def designs(task, candidates):
    """Two motions for identification and one for validation, from one start each, by the information."""
    return design_set(task, candidates[:3], trajectories=2)


@pytest.fixture(scope="module")
def informative(designs):
    return designs[0][0]


def test_the_condition_falls(task, candidates):
    judge = CRITERIA["condition"]
    conditioned = make_designer(task, judge, rounds=6, iterations=40)(candidates[:2])
    assert conditioned.condition < 0.75 * np.median([design.condition for design in candidates])


def test_the_information_rises(candidates, informative):
    """Random motions break no limit and use some, but show less."""
    assert all(0 < design.slack < 0.1 for design in candidates)
    middle = sorted(candidates, key=lambda design: design.log_determinant)[len(candidates) // 2]
    assert error_ratio([informative], [middle]) < 0.75
    assert informative.log_determinant > max(design.log_determinant for design in candidates)


def test_limits_hold_at_ten_times_the_samples_that_were_checked(task, informative):
    motion = informative.motion
    q, qd, qdd = states(functions_at(task, 10 * FINER), motion.offset, motion.coefficients)
    assert np.all(q >= LIMITS.position[:, 0]) and np.all(q <= LIMITS.position[:, 1])
    assert np.all(abs(qd) <= LIMITS.velocity) and np.all(abs(qdd) <= LIMITS.acceleration)
    inverse = dynamics(MODEL.energies(PARAMETERS)).inverse_dynamics
    tau, elbow = jax.jit(jax.vmap(lambda *s: (inverse(*s)[0], world_frames(ARM, s[0])[1][1, 2])))(q, qd, qdd)
    assert np.all(abs(tau) <= LIMITS.force[0, 1]) and np.all(elbow >= -0.1)


def test_motions_rest_at_both_ends_and_rates_are_derivatives(task, informative):
    motion = informative.motion
    q, qd, qdd = sample(motion, np.array([0.0, task.period]))
    np.testing.assert_allclose(q[0], q[1], atol=1e-12)
    np.testing.assert_allclose([qd, qdd], 0, atol=1e-12)
    at = np.array([0.7])
    (_, *rates), slopes = jax.jit(lambda t: jax.jvp(lambda t: sample(motion, t), (t,), (0 * t + 1,)))(at)
    np.testing.assert_allclose(slopes[:2], rates, atol=1e-12)


def test_columns_that_others_explain_are_left_out(task):
    # Two links in a plane: I_zz, h_x, h_y each (the first with the second's mass), the second's motor; friction.
    assert task.columns.size == 7 + 6
    random = np.random.default_rng(0)
    a, b, c, noise = random.normal(size=(4, 40))
    kept = independent_columns(np.column_stack([a, 0 * a, b, a - 2 * b, 1e3 * c]))
    assert kept.size == 3 and 4 in kept and 1 not in kept
    # A column that only rounded right angles of a file leave does not count as a parameter.
    assert independent_columns(np.column_stack([a, b, a + 1e-4 * noise])).size == 2


LINEAR = make_planar_chain(Needs(("revolute", "revolute"), friction=True))
"""Much quicker to compile than a tree."""
HEAVY = drawn(LINEAR)._replace(weight=np.array([8.0, 4.0]))


def test_the_regressor_and_its_slope_are_those_of_autodiff():
    regressor, theta = linear_force(LINEAR, HEAVY)
    at = [*map(jnp.array, ([0.3, -1.1], [0.05, -0.8], [2.0, 1.0]))]
    rows = np.random.default_rng(0).normal(size=(2, len(theta)))

    def with_slopes(f):
        """Phi, and the gradient of a function of it by the state."""
        slopes, Phi = jax.jit(jax.grad(lambda *at: (jnp.sum(rows * f(*at)), f(*at)), (0, 1, 2), has_aux=True))(*at)
        return Phi, np.array(slopes)

    Phi, slopes = with_slopes(lambda *at: linearised(LINEAR, HEAVY, *at)[0])
    ours, our_slopes = with_slopes(regressor)
    assert np.allclose(ours, Phi, atol=1e-12) and np.allclose(our_slopes, slopes, atol=1e-10)
    tau = jax.jit(dynamics(LINEAR.energies(HEAVY)).inverse_dynamics)(*at)
    assert np.allclose(Phi @ theta, tau, atol=1e-12)


def test_a_design_measures_what_it_says(informative):
    A, size = informative.information, informative.log_determinant
    assert np.isclose(np.linalg.slogdet(A)[1], size)
    assert np.allclose(together([informative] * 2), (informative.condition, size))
    assert np.isclose(CRITERIA["information"](jnp.asarray(A)), -size / (2 * len(A)))
    # Smooth means lie beyond the largest and the smallest, by at most the number of them.
    assert 0 <= float(CRITERIA["condition"](jnp.asarray(A))) - np.log(informative.condition) <= np.log(len(A)) / 4


def test_least_squares_on_the_motions_finds_the_parameters(task, candidates, designs):
    """Written as data, with the forces of the nominal model: they are what the model predicts, and of full rank."""
    train, validation = designs
    data = as_trajectories(
        [*train, validation], ["a", "b", "v"], MODEL, PARAMETERS, rate=50.0, needs=ARM.needs._replace(friction=True)
    )
    assert data.t.shape == (3 * 301,) and np.abs(data.qd[data.t == 0.0]).max() < 1e-12
    fit = fit_linear(MODEL, data, rank_tolerance=1e-8, negligible=1e-12)
    assert fit.rank == task.columns.size
    assert fit.torque_mse < 1e-18
    np.testing.assert_allclose(fit.parameters.coulomb, PARAMETERS.coulomb, rtol=1e-6)
    # Both motions are worth more than twice the better one alone is: they were not designed apart.
    assert error_ratio(train, candidates[:2]) < 0.8


def test_heights_leave_out_what_cannot_sink():
    heights = heights_above(ARM, 0.1)
    assert heights is not None
    # The first link turns about the origin; the second is half a metre away.
    reach = [float(heights(jnp.array([q, 0.0]))[0]) for q in (-np.pi / 2, 0.0, np.pi / 2)]
    assert np.allclose(sorted(reach), [-0.6, -0.1, 0.4], atol=1e-12)
    assert heights_above(LEVEL, 0.0) is None


def test_the_largest_excess_is_named_and_used_limits_shrink_towards_the_middle(task):
    q, qd, zero = jnp.array([-0.5, 0.0]), jnp.array([0.0, 4.0]), jnp.zeros(2)
    beyond, kind = worst(jax.jit(task.observe)(q, qd, zero)[2])
    assert kind == "velocity" and np.isclose(beyond, 4.0 / 3.0 - 1)
    half = scale_limits(LIMITS, 0.5)
    assert np.allclose(half.position, [[-1.25, 0.25], [-1.25, 1.25]])
    assert np.allclose(half.velocity, [1.0, 1.5]) and np.isinf(half.force[1]).all() and half.force[0, 1] == 11.0


def test_bad_input_is_one_line(task, candidates):
    def limited(**limits):
        return lambda: make_task(MODEL, PARAMETERS, LIMITS._replace(**limits))

    def stated(**settings):
        return lambda: make_task(MODEL, PARAMETERS, LIMITS, **settings)

    weak = LIMITS._replace(force=np.array([[-0.1, 0.1], [-0.1, 0.1]]))
    impossible = make_task(LINEAR, HEAVY, weak, period=6.0, harmonics=3)
    for message, call in {
        "no limit of velocity": limited(velocity=np.array([2.0, np.inf])),
        "limit of force on one side": limited(force=np.array([[-np.inf, 1.0], [-1, 1]])),
        "limits of position": limited(position=LIMITS.position[:, ::-1]),
        "limits of acceleration have shape": limited(acceleration=np.ones(3)),
        "harmonics is 1;": stated(harmonics=1),
        "period is 0": stated(period=0.0),
        "noise is": stated(noise=[0.1, 0.0]),
        "share is 1.5": lambda: scale_limits(LIMITS, 1.5),
        "half the sampling rate": lambda: require_sampling(period=2.0, harmonics=10, rate=10.0),
        "force by": lambda: random_designs(impossible, 1),
        "choose from": lambda: design_set(task, candidates, criterion="best"),
        "8 starts are too few": lambda: design_set(task, candidates, trajectories=8),
    }.items():
        with one_line(message):
            call()
