"""Where digits get lost: activations near 0 and in saturation, angles turned many times, single precision.

Errors are measured in rounding units. A function f is as accurate as it can be when its error is that of a few
roundings of its argument and of its value,

    |error| <= c eps (1 + kappa) |f|,   kappa = |x f'(x) / f(x)|        (relative condition number)

Source: Higham, "Accuracy and Stability of Numerical Algorithms" (2002), section 1.6.
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.metrics.report import expect, largest
from dln_jax.models.hamiltonian import make_structured_hamiltonian
from dln_jax.models.lagrangian import make_black_box_lagrangian, make_delan
from dln_jax.nn.activations import activation
from dln_jax.scenes.double_pendulum import double_pendulum
from dln_jax.types import Needs
from scripts.reports.case import Findings
from scripts.reports.stability.random_models import random_parameters, random_states, untrained

DTYPES = (np.float32, np.float64)
ROUNDINGS = 8.0
"""Rounding units that an activation may lose: a handful of operations, each of half a unit to two."""
TURNS = 1_000
WIDTH = 16
LAYERS = 3
RANGES = (np.pi, 3.0, 10.0)
"""Ranges of q, qd and qdd (or tau), for which all parts of the torque matter."""

_DENSITY = 1 / math.sqrt(2 * math.pi)
_Values = Callable[[np.ndarray], tuple]

# (g, g', g'') to the second order that counts: what is left out is below 1e-16 of them for |x| <= 1e-4.
NEAR_ZERO: dict[str, _Values] = {
    "tanh": lambda x: (x - x**3 / 3, 1 - x**2, -2 * x + 8 / 3 * x**3),
    "softplus": lambda x: (math.log(2) + x / 2 + x**2 / 8, 0.5 + x / 4 - x**3 / 48, 0.25 - x**2 / 16),
    "silu": lambda x: (x / 2 + x**2 / 4 - x**4 / 48, 0.5 + x / 2 - x**3 / 12, 0.5 - x**2 / 4),
    "gelu": lambda x: (
        x / 2 + _DENSITY * (x**2 - x**4 / 6),
        0.5 + 2 * _DENSITY * (x - x**3 / 3),
        2 * _DENSITY * (1 - x**2),
    ),
    "sin": lambda x: (x - x**3 / 6, 1 - x**2 / 2, -x + x**3 / 6),
    "cos": lambda x: (1 - x**2 / 2, -x + x**3 / 6, -1 + x**2 / 2),
}


def _tanh_tail(x: np.ndarray) -> tuple:
    u, sign = np.exp(-2 * abs(x)), np.sign(x)
    return sign * (1 - 2 * u), 4 * u * (1 - 2 * u), -8 * sign * u * (1 - 4 * u)


def _softplus_tail(x: np.ndarray) -> tuple:
    u = np.exp(-abs(x))
    slope = u * (1 - 2 * u)
    return np.where(x > 0, x + u, u * (1 - u / 2)), np.where(x > 0, 1 - u, u * (1 - u)), slope


def _silu_tail(x: np.ndarray) -> tuple:
    u = np.exp(-abs(x))
    return (
        np.where(x > 0, x - x * u, x * u * (1 - u)),
        np.where(x > 0, 1 + u * (x - 1), u * (1 + x) - u**2 * (1 + 2 * x)),
        np.where(x > 0, u * (2 - x) + u**2 * (4 * x - 4), u * (2 + x) - u**2 * (4 + 4 * x)),
    )


def _gelu_tail(x: np.ndarray) -> tuple:
    distribution = np.array([math.erfc(-value / math.sqrt(2)) / 2 for value in x])
    density = _DENSITY * np.exp(-(x**2) / 2)
    return x * distribution, distribution + x * density, density * (2 - x**2)


# Values far out, kappa of what decays, the nearest |x|, and the farthest one whose values are normal numbers.
SATURATED: dict[str, tuple[_Values, Callable, float, dict]] = {
    "tanh": (_tanh_tail, lambda x: 2 * abs(x), 10.0, {np.float32: 40.0, np.float64: 340.0}),
    "softplus": (_softplus_tail, abs, 20.0, {np.float32: 80.0, np.float64: 700.0}),
    "silu": (_silu_tail, abs, 20.0, {np.float32: 80.0, np.float64: 700.0}),
    "gelu": (_gelu_tail, lambda x: x**2, 5.0, {np.float32: 12.0, np.float64: 37.0}),
}


def activations() -> Findings:
    """Every smooth activation and its two derivatives against series near 0 and expansions in saturation."""
    near = {name: (series, np.ones_like, 1e-12, dict.fromkeys(DTYPES, 1e-4)) for name, series in NEAR_ZERO.items()}
    rows = []
    for place, regions in (("near-0", near), ("saturated", SATURATED)):
        errors = [_rounding_units(regions, dtype) for dtype in DTYPES]
        for name, (_, _, nearest, farthest) in regions.items():
            text = (
                f"g, g', g'' at {nearest:g} <= |x| <= {farthest[np.float64]:g} (f32: {farthest[np.float32]:g}) "
                f"within {ROUNDINGS:.0f} eps (1 + kappa) of their expansions"
            )
            got = largest([error[name] for error in errors])
            rows.append(expect(f"activations-{place}/{name}", "rounding_units", text, got, ROUNDINGS))
    return Findings(rows)


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
                "sum of |terms|, with what inputs rounded by as much change"
            )
            rows.append(expect(f"float32/{name}", f"{quantity}_rounding_units", text, got, float(roundings)))
        text = "float32 in, float32 out: nothing is widened"
        rows.append(expect(f"float32/{name}", "widened_outputs", text, float(both.dtype != np.float32), 0.0))
    return Findings(rows)


def _rounding_units(regions: dict, dtype) -> dict[str, float]:
    """Largest error of g, g' and g'' of each activation, in units of eps (1 + kappa) |f|; kappa of what decays."""
    points = {}
    for name, (_, _, nearest, farthest) in regions.items():
        sizes = np.geomspace(nearest, farthest[dtype], 65)
        points[name] = np.concatenate([-sizes, sizes]).astype(dtype)

    @jax.jit
    def evaluate(points):
        return {name: [function(x) for function in activation(name)[1:]] for name, x in points.items()}

    errors = {}
    for name, answers in evaluate(points).items():
        tail, kappa, *_ = regions[name]
        x, worst = points[name].astype(np.float64), []
        for value, wanted in zip(answers, tail(x), strict=True):
            condition = np.where(abs(wanted) < 0.1, kappa(x), 1.0)
            worst.append(largest(abs(np.asarray(value, np.float64) - wanted) / ((1 + condition) * abs(wanted))))
        errors[name] = largest(worst) / float(np.finfo(dtype).eps)
    return errors


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
