"""Mass matrices that are hard to solve with: condition numbers up to 1e12, and many degrees of freedom.

A solver that is backward stable leaves a residual of rounding whatever the condition number kappa of M, and an error
that kappa multiplies,

    |M x - b| <= c d eps |M| |x|,   |x - x_true| <= c d eps kappa |x|

Source: Higham, "Accuracy and Stability of Numerical Algorithms" (2002), theorems 8.5, 9.4 and 7.2.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.mechanics import lagrangian, natural
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.mechanics.natural import NaturalSystem
from dln_jax.metrics.definiteness import definiteness
from dln_jax.models.delan import make_delan
from dln_jax.scenes.chain import chain
from dln_jax.scenes.scene import closed_form_decomposition
from dln_jax.studies.case import Findings
from dln_jax.studies.report import Row, expect, largest
from dln_jax.studies.stability.random_models import random_parameters
from dln_jax.types import Needs

EPS = float(np.finfo(np.float64).eps)
FACTOR = 8.0
"""c: a few matrix products, each with its half rounding per term."""
CONDITIONS = (1.0, 1e4, 1e8, 1e12)
SIZES = (1, 2, 7, 12, 30)
_DIMENSION = 6
_SWING = 0.1


class _Stiff(NamedTuple):
    """M(q) = (1 + 0.1 sin q_0)² M0 with a prescribed condition number."""

    mass: np.ndarray
    """M0 [d, d]."""
    factor: np.ndarray
    """Its lower triangular factor."""


def mass_conditions() -> Findings:
    """Forward dynamics with mass matrices of condition 1 to 1e12, structured and general."""
    cases = []
    stiff = [_stiff(condition) for condition in CONDITIONS]
    q, qd, qdd = _states(16, _DIMENSION)
    for path, build in (("structured", _structured), ("general", _general)):
        solve = jax.jit(lambda factor, *states, build=build: jax.vmap(lambda *s: _solve(build(factor), *s))(*states))
        for condition, each in zip(CONDITIONS, stiff, strict=True):
            name = f"condition-{condition:.0e}/{path}".replace("e+", "e")
            tau, found, slope, mass = (np.asarray(part) for part in solve(each.factor, q, qd, qdd))
            residual, size = _residual(each, q, qd, found, tau)
            text = f"|M qdd + c - tau| <= {FACTOR:.0f} d eps of its terms, whatever the condition"
            got = largest(residual / (_DIMENSION * EPS * size))
            cases.append(expect(name, "residual_rounding_units", text, got, FACTOR))
            change = abs(found - qdd).max(axis=1) / (abs(qdd).max(axis=1) + abs(qd).max(axis=1) ** 2)
            text = f"qdd -> tau -> qdd within {FACTOR:.0f} d eps kappa"
            got = largest(change) / (_DIMENSION * EPS * condition)
            cases.append(expect(name, "round_trip_rounding_units", text, got, FACTOR))
            infinite = float(np.mean(~np.isfinite(slope)))
            text = "the gradient through the solve is finite"
            cases.append(expect(name, "gradients_not_finite_share", text, infinite, 0.0))
            if path == "structured":
                cases.append(_reported_condition(name, condition, mass))
    return Findings([*cases, *_singular()])


def sizes() -> Findings:
    """Chains of 1 to 30 rods by their energies against the closed form, and structured networks of as many joints."""
    cases = []
    for d in SIZES:
        scene = chain(d)
        q, qd, qdd = _states(4, d)
        # One state at a time: batched library calls within one program may wait for each other.
        found, accelerations = _mapped(dynamics(scene.energies), q, qd, qdd)
        parts, mass = jax.jit(
            lambda *states, scene=scene: jax.lax.map(
                lambda state: (closed_form_decomposition(scene, *state), scene.mass_matrix(state[0])), states
            )
        )(q, qd, qdd)
        angle, rate = abs(np.cumsum(q, axis=1)).max(axis=1), abs(np.cumsum(qd, axis=1)).max(axis=1)
        row_sum = abs(np.asarray(mass)).sum(axis=2).max(axis=1)
        size = row_sum * (abs(qdd).max(axis=1) + rate**2) + abs(np.asarray(parts.gravity)).max(axis=1)
        error = abs(found - np.asarray(sum(parts))).max(axis=1) / (size * (1 + angle))
        text = f"the energy's tau equals the closed form within {FACTOR:.0f} d eps of its terms, angles summed along"
        got = largest(error) / (d * EPS)
        cases.append(expect(f"d-{d}/chain", "inverse_rounding_units", text, got, FACTOR))
        cases.append(_round_trip(f"d-{d}/chain", qdd, accelerations, np.asarray(mass), found))
    for d in SIZES:
        model = make_delan(Needs(joints=("revolute",) * d), width=8, dtype=jnp.float64)
        system = dynamics(model.energies(random_parameters(model)))
        q, qd, qdd = _states(4, d)
        tau, accelerations = _mapped(system, q, qd, qdd)
        mass = np.asarray(jax.jit(jax.vmap(system.mass_matrix))(q))
        cases.append(_round_trip(f"d-{d}/structured-delan", qdd, accelerations, mass, tau))
    return Findings(cases)


def _stiff(condition: float) -> _Stiff:
    random = np.random.default_rng(1)
    vectors = np.linalg.qr(random.normal(size=(_DIMENSION, _DIMENSION)))[0]
    eigenvalues = np.geomspace(1.0, 1.0 / condition, _DIMENSION)
    upper = np.asarray(np.linalg.qr(np.sqrt(eigenvalues)[:, None] * vectors.T, mode="r"))
    factor = upper.T * np.sign(np.diag(upper))
    return _Stiff(factor @ factor.T, factor)


def _structured(factor) -> Dynamics:
    return natural.dynamics(NaturalSystem(lambda q: (1 + _SWING * jnp.sin(q[0])) * factor))


def _general(factor) -> Dynamics:
    energies = NaturalSystem(lambda q: (1 + _SWING * jnp.sin(q[0])) * factor)
    return lagrangian.dynamics(LagrangianSystem(natural.lagrangian(energies)))


def _solve(system: Dynamics, q, qd, qdd):
    """tau of qdd, qdd of that tau, a gradient through both, and M."""
    tau = system.inverse_dynamics(q, qd, qdd)
    slope = jax.grad(lambda q: jnp.sum(system.forward_dynamics(q, qd, tau)))(q)
    return tau, system.forward_dynamics(q, qd, tau), slope, system.mass_matrix(q, qd)


def _residual(stiff: _Stiff, q, qd, qdd, tau) -> tuple[np.ndarray, np.ndarray]:
    """|M qdd + c - tau| by the closed form, and the size of its terms."""
    scale, slope = 1 + _SWING * np.sin(q[:, 0]), _SWING * np.cos(q[:, 0])
    momentum = qd @ stiff.mass
    inertial = (scale**2)[:, None] * (qdd @ stiff.mass)
    coriolis = (2 * scale * slope * qd[:, 0])[:, None] * momentum
    coriolis[:, 0] -= scale * slope * np.sum(qd * momentum, axis=1)
    norm = abs(stiff.mass).sum(axis=1).max()
    size = norm * (abs(qdd).max(axis=1) + 2 * abs(qd).max(axis=1) ** 2 * _DIMENSION) + abs(tau).max(axis=1)
    return abs(inertial + coriolis - tau).max(axis=1), size


def _reported_condition(name: str, condition: float, mass: np.ndarray) -> Row:
    report = definiteness(_constant(mass[0]), np.zeros((1, _DIMENSION)), np.zeros((1, _DIMENSION)))
    text = f"the reported condition number is right within {FACTOR:.0f} d eps kappa, as M's own rounding allows"
    got = abs(report.largest_condition_number / condition - 1) / (_DIMENSION * EPS * condition)
    return expect(name, "condition_report_rounding_units", text, got, FACTOR, reference=condition)


def _constant(mass: np.ndarray) -> Dynamics:
    return lagrangian.dynamics(LagrangianSystem(lambda q, qd: 0.5 * qd @ jnp.asarray(mass) @ qd))


def _singular() -> list[Row]:
    """Matrices without an inverse: no finite acceleration may come of them."""
    ones = _constant(np.ones((2, 2)))
    flat = natural.dynamics(NaturalSystem(lambda q: jnp.array([[1.0, 0.0], [1.0, 0.0]])))
    text = "a singular M gives no finite acceleration: nothing is regularised silently"
    zero, tau = jnp.zeros(2), jnp.array([1.0, 2.0])
    return [
        expect(
            f"condition-infinite/{name}",
            "states_with_finite_qdd",
            text,
            float(np.isfinite(np.asarray(system.forward_dynamics(zero, zero, tau))).all()),
            0.0,
        )
        for name, system in (("general", ones), ("structured", flat))
    ]


def _mapped(system: Dynamics, q, qd, qdd) -> tuple[np.ndarray, np.ndarray]:
    """tau of qdd, and qdd of that tau."""

    def one(state):
        q, qd, qdd = state
        tau = system.inverse_dynamics(q, qd, qdd)
        return tau, system.forward_dynamics(q, qd, tau)

    tau, accelerations = jax.jit(lambda *states: jax.lax.map(one, states))(q, qd, qdd)
    return np.asarray(tau), np.asarray(accelerations)


def _round_trip(name: str, qdd: np.ndarray, found: np.ndarray, mass: np.ndarray, tau: np.ndarray) -> Row:
    d = qdd.shape[1]
    condition = np.linalg.cond(mass, p=np.inf)
    norm = abs(mass).sum(axis=2).max(axis=1)
    size = abs(qdd).max(axis=1) + abs(tau).max(axis=1) / norm
    text = f"qdd -> tau -> qdd within {FACTOR:.0f} d eps kappa, kappa up to {condition.max():.0e}"
    got = largest(abs(found - qdd).max(axis=1) / (d * EPS * condition * size))
    return expect(name, "round_trip_rounding_units", text, got, FACTOR)


def _states(samples: int, d: int) -> list[np.ndarray]:
    random = np.random.default_rng(0)
    return [random.uniform(-1, 1, (samples, d)) * size for size in (np.pi, 2.0, 5.0)]
