"""Where digits get lost: angles turned many times, single precision. Errors are measured in rounding units."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.hamiltonian import make_structured_hamiltonian
from dln_jax.models.lagrangian import make_black_box_lagrangian, make_delan
from dln_jax.scenes.pendulums import double_pendulum
from dln_jax.types import Needs
from scripts.reports.case import Findings
from scripts.reports.rows import expect, largest
from scripts.reports.stability.random_models import random_parameters, random_states, untrained

TURNS = 1_000
WIDTH = 16
LAYERS = 3
RANGES = (np.pi, 3.0, 10.0)
"""Ranges of q, qd and qdd (or tau) where all parts of the torque matter."""


def turned_angles() -> Findings:
    """A joint turned by 2 pi k, k = 1000, is where it was: the angle keeps eps 2 pi k, and the torque no less."""
    needs = Needs(joints=("revolute", "revolute"))
    double = {"needs": needs, "width": WIDTH, "dtype": jnp.float64}
    systems = [
        ("structured-delan", untrained(make_delan(**double)), np.float64),
        ("structured-delan-f32", untrained(make_delan(needs, width=WIDTH)), np.float32),
        ("black-box-delan", untrained(make_black_box_lagrangian(**double)), np.float64),
        ("structured-hnn", untrained(make_structured_hamiltonian(**double)), np.float64),
        ("double-pendulum", dynamics(double_pendulum().energies), np.float64),
    ]
    text = (
        f"tau after {TURNS} turns differs by |dtau/dq| times the rounding of the angle, 1.25 eps 2 pi k for the sum, "
        "the product and pi itself; 2 with that of tau"
    )
    rows = []
    for name, system, dtype in systems:
        q, qd, qdd = random_states(32, 2, RANGES, dtype)
        turn = np.asarray(2 * np.pi * TURNS, dtype) * np.array([1, -1], dtype)
        compiled = jax.jit(jax.vmap(system.inverse_dynamics))
        torque = lambda *states, compiled=compiled: np.asarray(compiled(*states))  # noqa: E731
        # Central differences: of a thousandth of a radian, or the square root of the rounding unit.
        steps = np.eye(2, dtype=dtype) * np.sqrt(np.finfo(dtype).eps)
        slopes = [abs(torque(q + step, qd, qdd) - torque(q - step, qd, qdd)) / (2 * step.max()) for step in steps]
        change = abs(torque(q + turn, qd, qdd) - torque(q, qd, qdd)).max(axis=1)
        got = largest(change / (np.sum(slopes, axis=0).max(axis=1) * float(np.finfo(dtype).eps) * 2 * np.pi * TURNS))
        rows.append(expect(f"turned-angles/{name}", "rounding_units", text, got, 2.0))
    return Findings(rows)


def float32() -> Findings:
    """float32 against float64: same parameters, same states, so that all that differs is rounding on the way."""
    needs = Needs(joints=("revolute", "revolute"))
    model = make_delan(needs, width=WIDTH)
    parameters = random_parameters(model)
    wide = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), parameters)
    pairs = [
        ("structured-delan", dynamics(model.energies(parameters)), dynamics(model.energies(wide))),
        ("double-pendulum", dynamics(double_pendulum().energies), dynamics(double_pendulum().energies)),
    ]
    roundings = LAYERS * WIDTH
    rows = []
    for name, narrow, exact in pairs:
        states = random_states(64, 2, RANGES, np.float32)
        both = _both_ways(narrow)(*states)
        sizes = _sizes(exact, *(state.astype(np.float64) for state in states))
        for quantity, value, (truth, size) in zip(("inverse", "forward"), np.swapaxes(both, 0, 1), sizes, strict=True):
            got = largest(abs(value - truth).max(axis=1) / size) / float(np.finfo(np.float32).eps)
            text = (
                f"{quantity} dynamics within {roundings} eps32 (layers times width: the roundings in series) of the "
                "sum of |terms|, plus the effect of inputs rounded by as much"
            )
            rows.append(expect(f"float32/{name}", f"{quantity}_rounding_units", text, got, float(roundings)))
        text = "float32 in, float32 out: nothing is widened"
        rows.append(expect(f"float32/{name}", "widened_outputs", text, float(both.dtype != np.float32), 0.0))
    return Findings(rows)


def _both_ways(system: Dynamics) -> Callable:
    one = lambda *state: jnp.stack([system.inverse_dynamics(*state), system.forward_dynamics(*state)])  # noqa: E731
    compiled = jax.jit(jax.vmap(one))
    return lambda *states: np.asarray(compiled(*states))


def _sizes(system: Dynamics, q, qd, x) -> list[tuple[np.ndarray, np.ndarray]]:
    """(torque, size) and (acceleration, size): by how much one relative rounding of everything changes each."""
    both_ways, small = _both_ways(system), 1e-6
    truth = both_ways(q, qd, x)
    moved = np.zeros(truth.shape)
    for index in range(3):
        for column in range(2):
            states = [q, qd, x]
            states[index] = states[index] * (1 + small * np.eye(2)[column])
            moved += abs(both_ways(*states) - truth) / small
    parts, mass = jax.jit(jax.vmap(lambda *s: (system.decompose(*s), system.mass_matrix(*s[:2]))))(q, qd, x)
    inertial, coriolis, gravity = (abs(np.asarray(part)) for part in parts)
    # What is solved for the acceleration is tau less the bias; the inverse of M passes the rounding on.
    solved = np.einsum("nij,nj->ni", abs(np.asarray(mass)), abs(truth[:, 1])) + abs(x) + coriolis + gravity
    passed_on = np.einsum("nij,nj->ni", abs(np.linalg.inv(mass)), solved)
    return [
        (truth[:, 0], (inertial + coriolis + gravity + moved[:, 0]).max(axis=1)),
        (truth[:, 1], (passed_on + moved[:, 1]).max(axis=1)),
    ]
