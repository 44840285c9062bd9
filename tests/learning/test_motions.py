"""Windows and gaps, and a damped oscillator that is recovered from its positions alone."""

import functools

import jax.numpy as jnp
import numpy as np
from calls import one_line

from dln_jax.data import schema
from dln_jax.data.splits import segments
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import GaussNewton
from dln_jax.learning.shooting import Weights, cut_measured_windows, phase_problem
from dln_jax.mechanics.hamiltonian import HamiltonianSystem
from dln_jax.models.model import Model


def motion_of(t, trajectory=None):
    """Samples of q = t, so that a window shows where it was cut."""
    t = np.asarray(t, float)
    arrays = {"t": t, "q": t[:, None], "qd": t[:, None], "qdd": t[:, None], "p": t[:, None]}
    return schema.from_arrays({**arrays, "trajectory": np.zeros(len(t)) if trajectory is None else trajectory})


def test_windows_never_cross_a_gap_nor_trajectories():
    t = np.concatenate([np.arange(7), 7.4 + np.arange(5), 20.0 + np.arange(2)]) / 6
    data = motion_of(t)
    # 1.4 steps are no gap, 8.6 are one.
    assert [len(segment) for segment in segments(data.t, data.trajectory, gap=1.3)] == [7, 5, 2]
    windows = cut_measured_windows(data, 4)
    steps = np.diff(windows.t, axis=1)
    assert steps.max() <= 1.5 * np.median(np.diff(t)) and steps.min() == 0
    np.testing.assert_array_equal(windows.weight.sum(axis=1), [4, 4, 4, 3, 2])
    # A window begins where the one before it ends, and t counts from there.
    np.testing.assert_array_equal(windows.q[1, 0], windows.q[0, -1])
    np.testing.assert_allclose(windows.t, windows.q[..., 0] - windows.q[:, :1, 0], atol=1e-15)
    assert windows.p is not None and windows.pd is None
    apart = cut_measured_windows(motion_of([0, 1, 2, 3, 4, 5], [0, 0, 0, 1, 1, 1]), 6)
    assert (apart.weight.sum(axis=1) == 3).all()


def damped() -> Model:
    """½ p² + ½ k q² with friction ½ b qd²; parameters k, b."""
    return Model(
        lambda key: jnp.ones(2),
        lambda c: HamiltonianSystem(
            lambda q, p: 0.5 * jnp.sum(p**2) + 0.5 * c[0] * jnp.sum(q**2),
            dissipation=lambda q, qd: 0.5 * c[1] * jnp.sum(qd**2),
        ),
    )


def test_a_damped_oscillator_is_recovered_from_its_positions():
    """An infinite deviation leaves out momenta, which are wrong."""
    k, b, t = 4.0, 0.3, np.arange(60) / 6
    w = np.sqrt(k - b**2 / 4)
    q = np.exp(-b * t / 2) * np.cos(w * t)
    p = -np.exp(-b * t / 2) * (b / 2 * np.cos(w * t) + w * np.sin(w * t))
    arrays = {"t": t, "q": q[:, None], "qd": p[:, None], "qdd": p[:, None], "p": p[:, None] + 0.2}
    windows = cut_measured_windows(schema.from_arrays({**arrays, "trajectory": np.zeros(60)}), 15)
    start = jnp.array([3.0, 0.0])
    task = phase_problem(damped(), start, windows, windows, weights=Weights((0.01, np.inf)), substeps=8)
    np.testing.assert_allclose(fit(task, GaussNewton(15)).parameters["model"], [k, b], rtol=1e-4)


def test_mistakes_are_named():
    data, start = motion_of(np.arange(8)), jnp.ones(2)
    windows = cut_measured_windows(data, 4)
    pose = functools.partial(phase_problem, damped(), start, windows)
    for call, message in [
        (lambda: cut_measured_windows(data, 1), "length is 1"),
        (lambda: pose(windows._replace(p=None), weights=Weights(0.1)), "no p"),
        (lambda: segments(data.t, data.trajectory, gap=0.9), "gap is 0.9"),
        (lambda: segments(np.zeros(2), np.array([0, 1])), "no trajectory has two samples"),
        (lambda: pose(windows._replace(t=windows.t[:0]), weights=Weights(0.1)), "0 to validate"),
        (lambda: pose(windows, substeps=0, weights=Weights(0.1)), "substeps is 0"),
        (lambda: pose(windows, weights=Weights(0.0)), "state_weight is 0"),
        (lambda: pose(windows, weights=Weights(1.0, 1.0)), "the data have no pd"),
    ]:
        with one_line(message):
            call()
