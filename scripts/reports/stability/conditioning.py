"""Mass matrices that are hard to solve with, of condition up to 1e12 or of many joints, and indefinite ones.

A backward stable solver leaves a residual of the size of rounding for any condition number kappa of M, and an error
proportional to kappa,

    |M x - b| <= c d eps |M| |x|,   |x - x_true| <= c d eps kappa |x|

Source: Higham, "Accuracy and Stability of Numerical Algorithms" (2002), theorems 8.5, 9.4 and 7.2.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.mechanics import closed_form, lagrangian, natural
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.mechanics.natural import NaturalSystem
from dln_jax.metrics.definiteness import definiteness
from dln_jax.models.lagrangian import make_black_box_lagrangian, make_delan
from dln_jax.scenes.pendulums import chain
from dln_jax.types import Needs
from scripts.reports.case import Findings
from scripts.reports.rows import Row, expect, largest
from scripts.reports.stability.random_models import random_states, untrained

EPS = float(np.finfo(np.float64).eps)
FACTOR = 8.0
"""c: a few matrix products with half a rounding per term."""
CONDITIONS = (1.0, 1e4, 1e8, 1e12)
SIZES = (1, 2, 7, 12, 30)
_DIMENSION = 6
_SWING = 0.1
_RANGES = (np.pi, 2.0, 5.0)
"""Ranges of q, qd and qdd."""


def mass_conditions() -> Findings:
    """Forward dynamics with M(q) = (1 + 0.1 sin q_0)² M0, M0 of condition 1 to 1e12, structured and general."""
    rows = []
    factors = [_factor_of_condition(condition) for condition in CONDITIONS]
    q, qd, qdd = random_states(16, _DIMENSION, _RANGES)
    unit = _DIMENSION * EPS
    for path, build in (("structured", natural.dynamics), ("general", _from_lagrangian)):
        solve = jax.jit(partial(_solve, build))
        for condition, factor in zip(CONDITIONS, factors, strict=True):
            name = f"condition-{condition:.0e}/{path}".replace("e+", "e")
            tau, solved, slope, mass = (np.asarray(part) for part in solve(factor, q, qd, qdd))
            residual, size = _residual(factor @ factor.T, q, qd, solved, tau)
            change = abs(solved - qdd).max(axis=1) / (abs(qdd).max(axis=1) + abs(qd).max(axis=1) ** 2)
            within = f"{FACTOR:.0f} d eps"
            text = f"|M qdd + c - tau| <= {within} of its terms, whatever the condition"
            got = largest(residual / (unit * size))
            rows.append(expect(name, "residual_rounding_units", text, got, FACTOR))
            text, got = f"qdd -> tau -> qdd within {within} kappa", largest(change) / (unit * condition)
            rows.append(expect(name, "round_trip_rounding_units", text, got, FACTOR))
            text, infinite = "the gradient through the solve is finite", np.mean(~np.isfinite(slope))
            rows.append(expect(name, "gradients_not_finite_share", text, infinite, 0.0))
            if path == "structured":
                zeros = np.zeros((1, _DIMENSION))
                report = definiteness(_constant(mass[0]), zeros, zeros)
                text = f"the reported condition number is right within {within} kappa, as M's own rounding allows"
                got = abs(report.largest_condition_number / condition - 1) / (unit * condition)
                rows.append(expect(name, "condition_report_rounding_units", text, got, FACTOR, reference=condition))
    # Matrices without an inverse.
    flat = natural.dynamics(NaturalSystem(lambda q: jnp.array([[1.0, 0.0], [1.0, 0.0]])))
    text = "a singular M gives no finite acceleration: nothing is regularised silently"
    zero, tau = jnp.zeros(2), jnp.array([1.0, 2.0])
    for name, system in (("general", _constant(np.ones((2, 2)))), ("structured", flat)):
        finite = np.isfinite(np.asarray(system.forward_dynamics(zero, zero, tau))).all()
        rows.append(expect(f"condition-infinite/{name}", "states_with_finite_qdd", text, finite, 0.0))
    return Findings(rows)


def sizes() -> Findings:
    """Chains of 1 to 30 rods: energies against the closed form, and structured networks with as many joints."""
    rows = []
    for d in SIZES:
        scene = chain(d)
        q, qd, qdd = random_states(4, d, _RANGES)
        tau, accelerations = _there_and_back(dynamics(scene.energies), q, qd, qdd)
        parts, mass = jax.jit(
            lambda *states, scene=scene: jax.lax.map(
                lambda state: (closed_form.decompose(scene.closed_form, *state), scene.mass_matrix(state[0])), states
            )
        )(q, qd, qdd)
        angle, rate = abs(np.cumsum(q, axis=1)).max(axis=1), abs(np.cumsum(qd, axis=1)).max(axis=1)
        row_sum = abs(np.asarray(mass)).sum(axis=2).max(axis=1)
        size = row_sum * (abs(qdd).max(axis=1) + rate**2) + abs(np.asarray(parts.gravity)).max(axis=1)
        error = abs(tau - np.asarray(sum(parts))).max(axis=1) / (size * (1 + angle))
        text = f"the energy's tau equals the closed form within {FACTOR:.0f} d eps of its terms, angles summed along"
        rows.append(expect(f"d-{d}/chain", "inverse_rounding_units", text, largest(error) / (d * EPS), FACTOR))
        rows.append(_round_trip(f"d-{d}/chain", qdd, accelerations, np.asarray(mass), tau))
    for d in SIZES:
        system = untrained(make_delan(Needs(joints=("revolute",) * d), width=8, dtype=jnp.float64))
        q, qd, qdd = random_states(4, d, _RANGES)
        tau, accelerations = _there_and_back(system, q, qd, qdd)
        mass = np.asarray(jax.jit(jax.vmap(system.mass_matrix))(q))
        rows.append(_round_trip(f"d-{d}/structured-delan", qdd, accelerations, mass, tau))
    return Findings(rows)


def indefinite_hessians() -> Findings:
    """Mass matrices that are not positive definite: known ones, and those of an untrained black-box network."""

    def known(q, qd):
        """M = diag(1, q_0): definite, singular and indefinite where q_0 is positive, 0 and negative."""
        return 0.5 * (qd[0] ** 2 + q[0] * qd[1] ** 2)

    q = np.array([[1.0, 0.0], [0.5, 0.0], [0.0, 0.0], [-1.0, 0.0], [np.nan, 0.0]])
    report = definiteness(lagrangian.dynamics(LagrangianSystem(known)), q, np.zeros_like(q))
    clean = definiteness(lagrangian.dynamics(LagrangianSystem(known)), q[:4], np.zeros((4, 2)))
    needs = Needs(joints=("revolute", "revolute"))
    system = untrained(make_black_box_lagrangian(needs, width=16, dtype=jnp.float64))
    states = random_states(64, 2, (np.pi, 2.0))
    network = definiteness(system, *states)
    mass = np.asarray(jax.jit(jax.vmap(system.mass_matrix))(*states))
    # Sylvester: a symmetric 2x2 matrix is definite if its first entry and its determinant are positive.
    definite = (mass[:, 0, 0] > 0) & (mass[:, 0, 0] * mass[:, 1, 1] - mass[:, 0, 1] ** 2 > 0)
    share = float(np.mean(~definite))
    case, untrained_case, error = "indefinite/known-matrices", "indefinite/black-box-delan", "share_wrongly_reported"
    unreported = float(np.isfinite(report.largest_condition_number)) + float(not np.isnan(report.smallest_eigenvalue))
    three = "M = diag(1, q_0) at q_0 = 1, 0.5, 0, -1, NaN: three of five are reported"
    least = "the smallest eigenvalue of the finite ones is -1, to rounding"
    none = "a singular M has an infinite condition number, and one that is NaN a NaN eigenvalue"
    negative = "an untrained black-box Lagrangian has negative kinetic energy in some direction, and it is reported"
    sylvester = f"the share reported is that by Sylvester's criterion, {share:.2f}"
    rows = [
        expect(case, error, three, abs(report.share_not_definite - 0.6), 0.0, reference=0.0),
        expect(case, "smallest_eigenvalue_error", least, abs(clean.smallest_eigenvalue + 1.0), 2 * EPS),
        expect(case, "singular_or_nan_unreported", none, unreported, 0.0),
        expect(untrained_case, "smallest_eigenvalue", negative, network.smallest_eigenvalue, 0.0, "kg m^2"),
        expect(untrained_case, error, sylvester, abs(network.share_not_definite - share), 0.0),
    ]
    return Findings(rows)


def _factor_of_condition(condition: float) -> np.ndarray:
    """Lower triangular factor of M0."""
    random = np.random.default_rng(1)
    vectors = np.linalg.qr(random.normal(size=(_DIMENSION, _DIMENSION)))[0]
    eigenvalues = np.geomspace(1.0, 1.0 / condition, _DIMENSION)
    upper = np.asarray(np.linalg.qr(np.sqrt(eigenvalues)[:, None] * vectors.T, mode="r"))
    return upper.T * np.sign(np.diag(upper))


def _from_lagrangian(energies: NaturalSystem) -> Dynamics:
    return lagrangian.dynamics(LagrangianSystem(natural.lagrangian(energies)))


def _constant(mass: np.ndarray) -> Dynamics:
    return lagrangian.dynamics(LagrangianSystem(lambda q, qd: 0.5 * qd @ jnp.asarray(mass) @ qd))


def _solve(build, factor, *states):
    """tau from qdd, qdd from that tau, a gradient through both, and M, by state."""
    system = build(NaturalSystem(lambda q: (1 + _SWING * jnp.sin(q[0])) * factor))

    def one(q, qd, qdd):
        tau = system.inverse_dynamics(q, qd, qdd)
        slope = jax.grad(lambda q: jnp.sum(system.forward_dynamics(q, qd, tau)))(q)
        return tau, system.forward_dynamics(q, qd, tau), slope, system.mass_matrix(q, qd)

    return jax.vmap(one)(*states)


def _residual(mass: np.ndarray, q, qd, qdd, tau) -> tuple[np.ndarray, np.ndarray]:
    """|M qdd + c - tau| by the closed form, and the size of its terms."""
    scale, slope = 1 + _SWING * np.sin(q[:, 0]), _SWING * np.cos(q[:, 0])
    momentum = qd @ mass
    inertial = (scale**2)[:, None] * (qdd @ mass)
    coriolis = (2 * scale * slope * qd[:, 0])[:, None] * momentum
    coriolis[:, 0] -= scale * slope * np.sum(qd * momentum, axis=1)
    norm = abs(mass).sum(axis=1).max()
    size = norm * (abs(qdd).max(axis=1) + 2 * abs(qd).max(axis=1) ** 2 * _DIMENSION) + abs(tau).max(axis=1)
    return abs(inertial + coriolis - tau).max(axis=1), size


def _there_and_back(system: Dynamics, *states) -> tuple[np.ndarray, np.ndarray]:
    """tau from qdd, and qdd from that tau; one state at a time, as batched library calls in one program may wait."""

    def one(state):
        q, qd, qdd = state
        tau = system.inverse_dynamics(q, qd, qdd)
        return tau, system.forward_dynamics(q, qd, tau)

    tau, accelerations = jax.jit(lambda states: jax.lax.map(one, states))(states)
    return np.asarray(tau), np.asarray(accelerations)


def _round_trip(name: str, qdd: np.ndarray, solved: np.ndarray, mass: np.ndarray, tau: np.ndarray) -> Row:
    d = qdd.shape[1]
    condition = np.linalg.cond(mass, p=np.inf)
    size = abs(qdd).max(axis=1) + abs(tau).max(axis=1) / abs(mass).sum(axis=2).max(axis=1)
    text = f"qdd -> tau -> qdd within {FACTOR:.0f} d eps kappa, kappa up to {condition.max():.0e}"
    got = largest(abs(solved - qdd).max(axis=1) / (d * EPS * condition * size))
    return expect(name, "round_trip_rounding_units", text, got, FACTOR)
