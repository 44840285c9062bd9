"""The chaotic double pendulum for 1e5 steps, scored against its own Lyapunov time.

The largest Lyapunov exponent lambda is the mean rate at which ln |v| grows, v carried by the derivative of the step

    v <- d(step)/dx v

and, independently, that of the distance of a second motion that is rescaled to 1e-7 after every step (Benettin,
Galgani, Giorgilli and Strelcyn 1980, "Lyapunov characteristic exponents"). A perturbation e of a motion grows as
e exp(lambda t). Two forms of the same equations, which differ by rounding alone, diverge after ln(1/eps) / lambda, and
a motion with a step error e after ln(1/e) / lambda. No integrator can do better.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.mechanics import hamiltonian, integrators, natural
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.integrators import gauss_legendre4, rk4, second_order
from dln_jax.mechanics.natural import NaturalSystem
from dln_jax.rollout import rollout
from dln_jax.scenes.pendulums import double_pendulum
from dln_jax.scenes.scene import Scene
from scripts.reports.case import Findings
from scripts.reports.rows import Row, expect, largest

DT = 0.002
"""Time step, s; 1e5 steps are 200 s."""
COARSE = 5
"""Time step of the coarser motion, in steps of the finer."""
SEPARATION = 1e-7
"""Constant distance of the second motion, rad."""
STARTS = np.array([[2.0, 2.5], [2.2, -1.5], [-2.6, 2.0], [1.8, 3.0]])
"""Initial angles at rest, rad; all above the energy where the motion becomes chaotic."""


class Chaos(NamedTuple):
    """Motions of K starts over S steps, and how perturbations grow along them."""

    q: np.ndarray
    """[S, K, 2]."""
    qd: np.ndarray
    """[S, K, 2]."""
    tangent: np.ndarray
    """ln of the growth in each step, by the derivative, [S, K]."""
    pair: np.ndarray
    """The same by the second motion, [S, K]."""


def lyapunov_time(steps: int) -> Findings:
    """Prediction horizons relative to those that the Lyapunov exponent allows."""
    scene = double_pendulum()
    system, rewritten = dynamics(scene.energies), natural.dynamics(_factored(scene))
    chaos = _motions(system, steps)
    t = DT * np.arange(1, steps + 1)
    exponents = chaos.tangent.mean(axis=0) / DT
    by_pairs = chaos.pair.mean(axis=0) / DT
    rounded = _distance(chaos, rewritten, every=1)
    coarse = _distance(chaos, system, every=COARSE)
    eps = float(np.finfo(np.float64).eps)

    # A coarse step's error is the distance after one Lyapunov time, from where it grows e-fold in each.
    after_one = np.array([coarse[t[COARSE - 1 :: COARSE] <= 1 / rate, k].max() for k, rate in enumerate(exponents)])
    allowed = {"rounding": np.log(1 / eps) / exponents, "coarse-step": (1 + np.log(1 / after_one)) / exponents}
    seen = {"rounding": _horizon(rounded, t), "coarse-step": _horizon(coarse, t[COARSE - 1 :: COARSE])}
    name, ten = "lyapunov/double-pendulum", "every motion is chaotic: it lasts for ten Lyapunov times at least"
    both = "derivative of the step and second motion agree; curvature and rounding leave about 1e-5 / (lambda 1 s)"
    different = largest(abs(by_pairs / exponents - 1))
    rows = [
        expect(name, "smallest_exponent", ten, exponents.min(), 10 / t[-1], "1/s", at_least=True),
        expect(name, "exponents_relative_difference", both, different, 1e-3),
    ]
    for cause, expected in allowed.items():
        what = "ln(1/eps)" if cause == "rounding" else "ln(1/error after one Lyapunov time)"
        score = float(np.median(seen[cause] / expected))
        text = f"median time until the prediction is 1 rad off, in units of {what} / lambda: 1, within a factor of 2"
        name = f"lyapunov/{cause}"
        rows.append(expect(name, "horizon_score", text, score, 0.5, at_least=True, reference=1.0))
        rows.append(expect(name, "horizon_score_upper", text, score, 2.0, reference=1.0))
    rows.append(_energy_drift(scene, steps))
    return Findings(rows)


def _motions(system: Dynamics, steps: int) -> Chaos:
    step = rk4(second_order(lambda t, q, qd: system.forward_dynamics(q, qd, jnp.zeros_like(q))))

    def flow(x):
        return jnp.concatenate(step(0.0, (x[:2], x[2:]), DT))

    def advance(carry, _):
        x, tangent, pair = carry
        end, tangent = jax.jvp(flow, (x,), (tangent,))
        other = flow(x + SEPARATION * pair) - end
        growth, distance = jnp.linalg.norm(tangent), jnp.linalg.norm(other)
        return (end, tangent / growth, other / distance), (end, jnp.log(growth), jnp.log(distance / SEPARATION))

    def motion(q):
        x = jnp.concatenate([q, jnp.zeros_like(q)])
        direction = jnp.full(4, 0.5)
        return rollout(advance, (x, direction, direction), steps=steps, observe=lambda state, seen: seen)[1]

    x, tangent, pair = map(np.asarray, jax.jit(jax.vmap(motion, out_axes=1))(STARTS))
    return Chaos(x[..., :2], x[..., 2:], tangent, pair)


def _distance(chaos: Chaos, system: Dynamics, *, every: int) -> np.ndarray:
    """Largest difference of angles in rad, from the motion by another system or step, [S / every, K]."""
    step = rk4(second_order(lambda t, q, qd: system.forward_dynamics(q, qd, jnp.zeros_like(q))))
    t = every * DT * jnp.arange(len(chaos.q) // every + 1)

    @jax.jit
    def motions(starts):
        return jax.vmap(lambda q: integrators.rollout(step, (q, jnp.zeros_like(q)), t)[0], out_axes=1)(starts)

    return abs(np.asarray(motions(STARTS))[1:] - chaos.q[every - 1 :: every]).max(axis=-1)


def _horizon(distance: np.ndarray, t: np.ndarray) -> np.ndarray:
    """First times when motions are 1 rad off; infinite if they never are."""
    lost = ~(distance < 1.0)
    return np.where(lost.any(axis=0), t[np.argmax(lost, axis=0)], np.inf)


def _factored(scene: Scene) -> NaturalSystem:
    """The same energies, with the mass matrix as its Cholesky factor."""

    def cholesky(q):
        mass = scene.mass_matrix(q)
        first = jnp.sqrt(mass[0, 0])
        below = mass[0, 1] / first
        return jnp.array([[first, 0.0], [below, jnp.sqrt(mass[1, 1] - below**2)]])

    return NaturalSystem(cholesky, scene.potential)


def _energy_drift(scene: Scene, steps: int) -> Row:
    """Energy drift of a symplectic method, which conserves the energy of a chaotic motion though not the motion."""
    H = hamiltonian.legendre(scene.lagrangian)
    step = gauss_legendre4(lambda t, state: hamiltonian.time_derivative(H, state[0], state[1], jnp.zeros(2)))

    @jax.jit
    def energies(q):
        start = (q, jnp.zeros_like(q))
        advance = lambda state, _: (step(0.0, state, DT), None)  # noqa: E731
        return rollout(advance, start, steps=steps, observe=lambda state, _: H(*state))[1] - H(*start)

    error = np.asarray(energies(jnp.asarray(STARTS[0])))
    tenth = max(1, steps // 10)
    text = "mean energy error of Gauss-Legendre 4 in the last tenth within the range of the first: it does not drift"
    got = abs(error[-tenth:].mean() - error[:tenth].mean()) / float(np.ptp(error[:tenth]))
    return expect("lyapunov/gauss-legendre-4", "energy_drift_share", text, float(got), 1.0)
