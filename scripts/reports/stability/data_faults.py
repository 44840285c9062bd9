"""Data that break programs: constant torque channels, no samples or a single one, NaN and infinity."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.data import schema
from dln_jax.data.functions import FunctionSamples
from dln_jax.learning.linear import fit_linear
from dln_jax.learning.objectives import torque_scale
from dln_jax.learning.standardisation import standard_units, to_units
from dln_jax.mechanics.dynamics import Dynamics, PlainDynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.baselines import make_feed_forward
from dln_jax.models.lagrangian import make_black_box_lagrangian, make_delan
from dln_jax.models.trigonometric import make_trigonometric
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.pendulums import double_pendulum
from dln_jax.scenes.poles import cart_pole
from dln_jax.types import InputError, Needs
from scripts.reports.case import Findings
from scripts.reports.rows import expect, largest
from scripts.reports.stability.random_models import untrained

WIDTH = 8


def torque_channels() -> Findings:
    """Torque channels that are zero or constant, and data without any varying channel."""
    scene = cart_pole()
    data = generators.uniform(scene, samples=200)  # the pole has no motor: tau_1 = 0
    constant = data._replace(tau=data.tau * [1.0, 0.0] + [0.0, 5.0])
    rows = []
    for name, faulty in (("zero-channel", data), ("constant-channel", constant)):
        scale = np.asarray(torque_scale(faulty))
        wrong = float(np.sum(~(np.isfinite(scale) & (scale > 0))))
        text = "the unit of every channel is finite and positive: nothing is divided by zero"
        rows.append(expect(f"torque/{name}", "channels_without_unit", text, wrong, 0.0))
    fit = fit_linear(make_trigonometric(scene.needs, degree=(0, 1)), data)
    rounding = (np.finfo(np.float64).eps * fit.condition * abs(data.tau).max()) ** 2 * fit.parameter_count
    text = "the zero channel is fitted with the other, to rounding: (eps condition tau)² P"
    rows.append(expect("torque/zero-channel", "torque_mse", text, fit.torque_mse, float(rounding), "N^2"))
    still = data._replace(tau=np.zeros_like(data.tau))
    text = "torques that are all zero, or all constant, are refused: they fit any multiple of an energy"
    for name, faulty in (("all-zero", still), ("all-constant", still._replace(tau=still.tau + 3.0))):
        accepted = float(not _refuses(lambda faulty=faulty: torque_scale(faulty), "tau"))
        rows.append(expect(f"torque/{name}", "accepted", text, accepted, 0.0))
    samples = FunctionSamples(np.c_[np.arange(5.0), np.ones(5)], np.full((5, 1), 2.0), None, None)
    units = standard_units(samples)
    scaled = to_units(samples, units)
    wrong = float(sum(np.sum(~np.isfinite(array)) for array in (*units, scaled.x, scaled.y)))
    text = "inputs and outputs that do not vary are finite in standard units"
    return Findings([*rows, expect("torque/standard-units", "numbers_not_finite", text, wrong, 0.0)])


def batches() -> Findings:
    """No sample and one sample, through every kind of model, and through the schema."""
    rows = []
    for name, (system, answer) in _systems().items():
        empty, one = answer(*np.zeros((3, 0, 2))), answer(*np.full((3, 1, 2), 0.3))
        wrong = float(sum(leaf.shape[0] != 0 or leaf.dtype != np.float64 for leaf in empty))
        text = "no samples in, no samples out: arrays of length 0, of the same type"
        rows.append(expect(f"batches/{name}-empty", "wrong_outputs", text, wrong, 0.0))
        single = [jax.jit(system.inverse_dynamics)(*jnp.full((3, 2), 0.3))]
        text = "a batch of one is the single call, to rounding: 16 eps of its size"
        size = abs(np.asarray(single[0])).max()
        got = largest(abs(one[0][0] - single[0])) / float(size * np.finfo(np.float64).eps)
        rows.append(expect(f"batches/{name}-one", "rounding_units", text, got, 16.0))
    for samples in (0, 1):
        arrays = {"t": np.arange(samples), "q": np.ones((samples, 2)), "trajectory": np.zeros(samples, int)}
        accepted = float(not _refuses(lambda arrays=arrays: schema.from_arrays(arrays), "q has"))
        text = f"a file of {samples} samples is refused, and q named"
        rows.append(expect(f"batches/file-of-{samples}", "accepted", text, accepted, 0.0))
    return Findings(rows)


def not_finite() -> Findings:
    """NaN and infinity: refused with their place in a file, and never turned into a finite answer by a model."""
    good = {"t": np.arange(6.0), "trajectory": np.zeros(6, int)}
    good |= {key: np.ones((6, 2)) for key in ("q", "qd", "qdd", "tau")}
    rows = []
    for label, value in (("nan", np.nan), ("infinity", np.inf)):
        accepted = 0
        for key in ("t", "q", "qd", "qdd", "tau"):
            bad = np.array(good[key], float)
            bad[4] = value
            arrays = {**good, key: bad}
            accepted += not _refuses(lambda arrays=arrays: schema.from_arrays(arrays), f"{key} has", "sample 4")
        text = "each key that holds one is refused with its name and the sample"
        rows.append(expect(f"not-finite/{label}-in-file", "keys_accepted", text, float(accepted), 0.0))
    for name, (_, answer) in _systems().items():
        for label, value in (("nan", np.nan), ("infinity", np.inf)):
            # Row 2 i + j has it in coordinate j of argument i.
            states = np.full((3, 6, 2), 0.3)
            for row in range(6):
                states[row // 2, row, row % 2] = value
            finite = float(sum(np.isfinite(leaf).all(axis=1).sum() for leaf in answer(*states)))
            text = f"{label} in any of q, qd, qdd or tau gives no wholly finite answer (12 asked)"
            rows.append(expect(f"not-finite/{label}-in-{name}", "finite_answers", text, finite, 0.0))
    return Findings(rows)


@functools.cache
def _systems() -> dict[str, tuple[Dynamics | PlainDynamics, Callable[..., list[np.ndarray]]]]:
    """Systems by name, and functions that compute tau and qdd of a batch, compiled once for all cases."""
    arm, cart = Needs(joints=("revolute", "revolute")), Needs(joints=("prismatic", "revolute"))
    models = {
        "structured-delan": (make_delan, arm),
        "structured-delan-prismatic": (make_delan, cart),
        "black-box-delan": (make_black_box_lagrangian, arm),
        "feed-forward": (make_feed_forward, arm),
    }
    built = {name: make(needs, width=WIDTH, dtype=jnp.float64) for name, (make, needs) in models.items()}
    systems = {name: untrained(model) for name, model in built.items()}
    systems["double-pendulum"] = dynamics(double_pendulum().energies)
    return {name: (system, _answers(system)) for name, system in systems.items()}


def _answers(system: Dynamics | PlainDynamics) -> Callable[..., list[np.ndarray]]:
    compiled = jax.jit(jax.vmap(lambda *state: (system.inverse_dynamics(*state), system.forward_dynamics(*state))))
    return lambda *states: [np.asarray(leaf) for leaf in compiled(*states)]


def _refuses(action: Callable[[], object], *words: str) -> bool:
    """Whether an action is refused with a message that contains all the words."""
    try:
        action()
    except InputError as error:
        return all(word in str(error) for word in words)
    return False
