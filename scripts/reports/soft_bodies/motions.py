"""Motions with exactly known steps, and the invariants that a method keeps or loses.

Backward Euler in free fall is n steps of a sum, x_n = x_0 + n h v_0 + g h² n (n + 1)/2. On a linear oscillator of
angular frequency w the amplitude sqrt(w² x² + v²) shrinks by (1 + w² h²)^-1/2 per step, and stays with the midpoint
rule, which also keeps every quadratic invariant: angular momentum. Source: Hairer, Lubich and Wanner, "Geometric
Numerical Integration" (2006), sections IV.2 and VI.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.mesh.shapes import beam
from dln_jax.softbody.scene import Params, SoftScene, State, make_scene, potential, with_parameters
from dln_jax.softbody.step import BACKWARD_EULER, INTEGRATORS, Integrator, make_step
from dln_jax.softbody.terms.gravity import gravity
from dln_jax.softbody.terms.springs import springs
from scripts.reports.case import Findings
from scripts.reports.rows import expect, largest
from scripts.reports.soft_bodies.common import GRAVITY, Seen, converges, motion, solid

DT = 0.01
STEPS = 50
TOLERANCE = 1e-9
"""Tolerance of the steps, m/s²: exact properties of the method then hold to rounding."""
ORDERS = {"backward-euler": 1, "bdf2": 2, "midpoint": 2}
DURATION = 1.0
"""Length of the swing for measuring orders, s."""
SWING = np.array([[0.0, 0.0], [0.0, 1.0], [0.5, -1.0]])
"""Velocities at its start, in m/s."""


def free_fall(quick: bool) -> Findings:
    """A body thrown without deformation: every vertex follows the method's formula to rounding."""
    scene, init, run = _thrown(BACKWARD_EULER)
    velocity = np.array([1.0, 2.0])
    seen = run(scene.params, init(v=velocity))
    n = np.arange(1, STEPS + 1)[:, None, None]
    fall = n * DT * velocity + np.array([0.0, -GRAVITY]) * DT**2 * n * (n + 1) / 2
    error = largest(abs(seen.x - scene.mesh.vertices - fall))
    text = f"{STEPS} steps of {DT} s end where the sum says, to rounding"
    return Findings([expect("free-fall/backward-euler", "largest_position_error", text, error, 1e-12, "m")])


def invariants(quick: bool) -> Findings:
    """A free body that turns and wobbles: momentum, angular momentum, energy."""
    cases, curves = [], {}
    for integrator in ("backward-euler", "midpoint"):
        scene, init, run = _thrown(INTEGRATORS[integrator])
        params = _weightless(scene.params)
        start = init(v=_turning(scene))
        seen = run(params, start)
        x, v = np.concatenate([start.x[None], seen.x]), np.concatenate([start.v[None], seen.v])
        masses = np.asarray(params.masses)
        momentum = np.einsum("n,tnd->td", masses, v)
        turning = np.einsum("n,tn->t", masses, x[..., 0] * v[..., 1] - x[..., 1] * v[..., 0])
        stored = jax.jit(jax.vmap(lambda x, scene=scene, params=params: potential(scene, x, params)))(jnp.asarray(x))
        energy = 0.5 * np.einsum("n,tnd->t", masses, v**2) + np.asarray(stored)
        curves[integrator] = energy / energy[0]
        name = f"free-body/{integrator}"
        drift = largest(abs(momentum - momentum[0])) / float(np.sum(masses[:, None] * abs(v[0])))
        cases += [
            converges(name, seen.converged),
            expect(name, "momentum_drift", "internal forces sum to zero: exact to rounding", drift, 1e-12),
        ]
        if integrator == "midpoint":
            text = "a quadratic invariant: exact to the tolerance of the steps"
            cases.append(
                expect(name, "angular_momentum_drift", text, largest(abs((turning - turning[0]) / turning[0])), 1e-9)
            )
            text = "no drift: the energy stays within the step's error of second order"
            cases.append(expect(name, "largest_energy_error", text, largest(abs(energy / energy[0] - 1)), 0.02))
            continue
        text, rise = "it dissipates: the energy rises in no step, to rounding", largest(np.diff(energy)) / energy[0]
        cases.append(expect(name, "largest_energy_rise", text, rise, 1e-12))
        text = "it damps rotation too: angular momentum grows in no step, to rounding"
        lost = largest(np.diff(turning) / turning[0])
        cases.append(expect(name, "largest_angular_momentum_rise", text, lost, 1e-12))
    return Findings(cases, curves)


def oscillator(quick: bool) -> Findings:
    """Amplitude of a linear oscillator over steps of w h = 1 and less."""
    cases = []
    for integrator in ("backward-euler", "midpoint"):
        steps = min(_counts(quick))
        h = DURATION / steps
        scene = _two_masses()
        init, step = make_step(scene, h, INTEGRATORS[integrator], tolerance=TOLERANCE)
        unit = {"stiffness": np.array([1e3, 1e3]), "rest_length": np.zeros(2)}
        params = _weightless(with_parameters(scene.params, springs=unit))
        # Only the last mass moves: the other hangs from the ceiling by springs that balance.
        masses = np.asarray(params.masses)
        frequencies, modes = _spring_modes(masses[1:], 1e3)
        x = np.zeros((3, 2))
        x[1:, 0] = 0.1 * modes[:, 0]
        seen = motion(step, steps)(params, init(x))
        amplitude = np.sqrt(frequencies[0] ** 2 * seen.x[:, 2, 0] ** 2 + seen.v[:, 2, 0] ** 2)
        first = frequencies[0] * 0.1 * abs(modes[1, 0])
        factors = amplitude / np.concatenate([[first], amplitude[:-1]])
        exact = (1 + (frequencies[0] * h) ** 2) ** -0.5 if integrator == "backward-euler" else 1.0
        text = "(1 + w²h²)^-1/2 per step" if integrator == "backward-euler" else "the amplitude stays"
        text += f", w h = {frequencies[0] * h:.2g}"
        error = largest(abs(factors - exact))
        cases.append(expect(f"oscillator/{integrator}", "amplitude_factor_error", text, error, 1e-10, reference=exact))
    return Findings(cases)


def orders(quick: bool) -> Findings:
    """Errors of a swing of two masses on springs against an explicit method with tiny steps."""
    counts = _counts(quick)
    cases, curves = [], {"dt": DURATION / np.array(counts)}
    scene = _two_masses()
    reference = _reference_swing(scene)
    for name, integrator in INTEGRATORS.items():

        @jax.jit  # one program for every step length
        def end(count: Any, integrator: Integrator = integrator) -> Any:
            init, step = make_step(scene, DURATION / count, integrator, tolerance=TOLERANCE)
            return jax.lax.fori_loop(0, count, lambda _, state: step(scene.params, state, None)[0], init(v=SWING)).x

        errors = [largest(abs(np.asarray(end(count)) - reference)) for count in counts]
        curves[name] = np.array(errors)
        order, expected = np.log2(errors[-2] / errors[-1]), float(ORDERS[name])
        text = f"order {ORDERS[name]} between {counts[-2]} and {counts[-1]} steps, against RK4 in NumPy"
        cases.append(expect(f"order/{name}", "order_error", text, abs(order - expected), 0.15, reference=expected))
    return Findings(cases, curves)


@functools.cache
def _thrown(integrator: Integrator) -> tuple[SoftScene, Callable[..., State], Callable[[Params, State], Seen]]:
    scene = solid(beam(1.0, 0.25, 4, 1), modulus=1e5)
    init, step = make_step(scene, DT, integrator, tolerance=TOLERANCE)
    return scene, init, motion(step, STEPS)


def _two_masses() -> SoftScene:
    """Two masses that hang from a point by springs."""
    mesh = Mesh(np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]), np.zeros((0, 3), int))
    pulls = springs([[0, 1], [1, 2]], stiffness=[100.0, 60.0], rest_length=[1.0, 1.0])
    return make_scene(mesh, [pulls, gravity(mesh, (0.0, -GRAVITY))], masses=[1.0, 1.0, 0.7], held=[0])


def _counts(quick: bool) -> tuple[int, ...]:
    return (200, 400) if quick else (100, 200, 400)


def _weightless(params: Params) -> Params:
    return with_parameters(params, gravity={"acceleration": np.zeros(2)})


def _turning(scene: SoftScene) -> np.ndarray:
    """Rotation about the centre and a bending of the body, with some speed on top; in m/s."""
    x = scene.mesh.vertices - scene.mesh.vertices.mean(axis=0)
    bending = np.stack([np.zeros(len(x)), 8.0 * (x[:, 0] ** 2 - 0.1)], axis=1)
    return np.stack([-x[:, 1], x[:, 0]], axis=1) * 3.0 + bending + np.array([0.5, 0.2])


def _spring_modes(masses: np.ndarray, stiffness: float) -> tuple[np.ndarray, np.ndarray]:
    """Angular frequencies in rad/s, ascending, and modes of two masses on two equal springs below each other."""
    matrix = stiffness * np.array([[2.0, -1.0], [-1.0, 1.0]])
    root = masses**-0.5
    squared, vectors = np.linalg.eigh(root[:, None] * matrix * root)
    return np.sqrt(squared), root[:, None] * vectors


def _reference_swing(scene: SoftScene) -> np.ndarray:
    """The last positions by RK4 in 20,000 steps, written in NumPy."""
    stiffness, length = (np.asarray(leaf) for leaf in scene.params.terms["springs"])
    masses = np.asarray(scene.params.masses)

    def acceleration(x: np.ndarray) -> np.ndarray:
        d = np.diff(x, axis=0)
        distance = np.linalg.norm(d, axis=1)
        pull = (stiffness * (distance - length) / distance)[:, None] * d
        force = np.zeros_like(x)
        force[:-1] += pull
        force[1:] -= pull
        result = force / masses[:, None] + np.array([0.0, -GRAVITY])
        result[0] = 0.0
        return result

    def rate(y: np.ndarray) -> np.ndarray:
        return np.stack([y[1], acceleration(y[0])])

    y, count = np.stack([scene.mesh.vertices, SWING]), 20_000
    h = DURATION / count
    for _ in range(count):
        a = rate(y)
        b = rate(y + h / 2 * a)
        c = rate(y + h / 2 * b)
        y = y + h / 6 * (a + 2 * b + 2 * c + rate(y + h * c))
    return y[0]
