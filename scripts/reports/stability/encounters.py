"""Motions that are hard to integrate: past a saddle again and again, and two bodies that nearly meet.

A pendulum is let go just below upright, for 1e5 steps. A symplectic method follows a modified energy H + dt² f + ...,
so that its energy error stays below dt^p times a number that the backward error analysis gives, however long it runs.
On the separatrix p² = 2 g (1 + c), c = cos q, of H = p²/2 + g (1 - cos q), with f = 0 at the saddle c = -1:

    symplectic Euler    dt/2 |p V'| <= 0.770 g^1.5 dt
    Störmer-Verlet      dt²/24 (2 p² V'' - V'²) <= dt² g²/3
    implicit midpoint   dt²/24 (p² V'' + V'²) <= dt² g²/6
    Gauss-Legendre 4    of order dt⁴: (g dt²)² g

Source: Hairer, Lubich and Wanner, "Geometric Numerical Integration" (2006), sections IX.3 and IX.8.

Where two bodies nearly meet the step must shrink or be refused, and gradients stay finite. On a Kepler orbit
of semi-major axis 1 and eccentricity e the distance falls to r = 1 - e. An error of the tolerance in position there is
one of tolerance / r² in energy; a few dozen steps are that near.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq

from dln_jax.mechanics.integrators import (
    adaptive_rollout,
    gauss_legendre4,
    implicit_midpoint,
    rollout,
    second_order,
    stormer_verlet,
    symplectic_euler,
)
from scripts.reports.case import Findings
from scripts.reports.rows import expect, largest

GRAVITY = 9.81
DT = 0.01
"""Time step, s; 1e5 steps are 1000 s, some 130 swings."""
BELOW_UPRIGHT = 1e-3
"""Initial angle from the saddle, rad; the swing starts from rest."""
HIGHER_ORDERS = 1.1
"""Allowance for the next orders of the expansion: g dt² and sqrt(g) dt are 0.001 and 0.03."""
TOLERANCE = 1e-12
STEPS_NEAR = 100
"""Steps whose errors may add up at the nearest point."""
NEAREST = 1e-3
"""Semi-major axis 1, eccentricity 0.999."""


def separatrix(steps: int) -> Findings:
    """Energy errors of the symplectic methods over `steps` steps, and whether they ever go over the top."""

    def force(q):
        return GRAVITY * jnp.sin(q)

    def field(t, state):
        q, p = state
        return p, -force(q)

    methods = {
        "symplectic-euler": symplectic_euler(lambda t, q, p: p, lambda t, q, p: -force(q)),
        "stormer-verlet": stormer_verlet(lambda t, p: p, lambda t, q: -force(q)),
        "implicit-midpoint": implicit_midpoint(field),
        "gauss-legendre-4": gauss_legendre4(field),
    }
    references = {
        "symplectic-euler": 4 / 2 / np.sqrt(3) * (2 / 3) * GRAVITY**1.5 * DT,
        "stormer-verlet": GRAVITY**2 * DT**2 / 3,
        "implicit-midpoint": GRAVITY**2 * DT**2 / 6,
        "gauss-legendre-4": GRAVITY * (GRAVITY * DT**2) ** 2,
    }
    start = (jnp.array([np.pi - BELOW_UPRIGHT]), jnp.zeros(1))
    t = DT * jnp.arange(steps + 1)
    rows = []
    for name, step in methods.items():
        q, p = jax.jit(lambda t, step=step: rollout(step, start, t))(t)
        q, p = np.asarray(q)[:, 0], np.asarray(p)[:, 0]
        energy = p**2 / 2 + GRAVITY * (1 - np.cos(q))
        reference = float(references[name])
        text = f"energy error over {steps:,} steps of {DT} s below the amplitude of the modified energy, no drift"
        got, bound = largest(abs(energy - energy[0])), HIGHER_ORDERS * reference
        rows.append(expect(f"separatrix/{name}", "largest_energy_error", text, got, bound, "J", reference=reference))
        text = f"released {BELOW_UPRIGHT:g} rad below upright, it never goes over the top: |q| < pi"
        below = float(np.pi) - largest(abs(q))
        rows.append(expect(f"separatrix/{name}", "least_angle_from_upright", text, below, 0.0, "rad", at_least=True))
    return Findings(rows)


def close_encounters() -> Findings:
    """A whole orbit that nearly collides, a collision, and implicit steps that are too long for it."""
    start = jnp.array([2.0 - NEAREST, 0.0]), jnp.array([0.0, (2 / (2.0 - NEAREST) - 1) ** 0.5])
    field = second_order(lambda t, q, qd: -q / jnp.sum(q**2) ** 1.5)
    t = jnp.linspace(0.0, 2 * jnp.pi, 65)

    def distance_at_end(speed):
        (q, _), _ = adaptive_rollout(field, (start[0], start[1] * speed), t[:49], tolerance=TOLERANCE, max_steps=4096)
        return jnp.sum(q[-1] ** 2)

    (q, qd), finished = jax.jit(lambda: adaptive_rollout(field, start, t, tolerance=TOLERANCE))()
    energy = np.asarray(0.5 * jnp.sum(qd**2, axis=1) - 1 / jnp.linalg.norm(q, axis=1))
    bound = STEPS_NEAR * TOLERANCE / NEAREST**2
    slope = jax.jit(jax.grad(distance_at_end))(1.0)
    speed, h, last = float(start[1][1]), 1e-6, float(t[48])
    ends_of_orbit = [_kepler_distance(speed * factor, 2.0 - NEAREST, last) ** 2 for factor in (1 + h, 1 - h)]
    exact = (ends_of_orbit[0] - ends_of_orbit[1]) / (2 * h)
    rest = jnp.array([0.1, 0.0]), jnp.zeros(2)
    _, collided = jax.jit(lambda: adaptive_rollout(field, rest, t[:9], tolerance=TOLERANCE, max_steps=2_000))()

    dts = jnp.geomspace(1e-4, 1.0, 33)
    near = jnp.array([NEAREST, 0.0]), jnp.array([0.0, ((2 - NEAREST) / NEAREST) ** 0.5])
    step = implicit_midpoint(field)
    ends = jax.jit(jax.vmap(lambda dt: step(0.0, near, dt)))(dts)
    wrong, refused = _wrong_steps(field, near, ends, dts)
    adaptive, near = "close-encounter/adaptive", f"below {STEPS_NEAR} errors of tolerance / r²"
    whole = f"an orbit of eccentricity {1 - NEAREST} is finished: the step adapts"
    kepler = "the derivative through the encounter is that of Kepler's orbit, within the same tolerance / r²"
    head_on = "bodies that meet head-on end the integration: it says that it has not finished"
    solved = f"33 steps of 1e-4 to 1 s are solutions of the method's equations or NaN ({refused} refused)"
    rows = [
        expect(adaptive, "orbits_not_finished", whole, not finished, 0.0),
        expect(adaptive, "largest_energy_error", near, largest(abs(energy - energy[0])), bound, "J"),
        expect("close-encounter/gradient", "relative_difference", kepler, abs(slope / exact - 1), bound),
        expect("close-encounter/collision", "reported_as_finished", head_on, collided, 0.0),
        expect("close-encounter/implicit-midpoint", "finite_states_that_are_no_step", solved, wrong, 0.0),
    ]
    return Findings(rows)


def _wrong_steps(field, start, ends, dts) -> tuple[int, int]:
    """Steps that are finite and do not satisfy y1 = y0 + dt f((y0 + y1) / 2), and those that are not finite."""
    finite = np.isfinite(np.concatenate(ends, axis=1)).all(axis=1)
    middle = [(first + last) / 2 for first, last in zip(start, ends, strict=True)]
    wrong = 0
    for first, last, rate in zip(start, ends, jax.vmap(lambda *state: field(0.0, state))(*middle), strict=True):
        change = np.asarray(dts[:, None] * rate)
        off = np.asarray(abs(last - first - change)).max(axis=1) > 1e-9 * (1 + abs(change).max(axis=1))
        wrong += int(np.sum(off & finite))
    return wrong, int(np.sum(~finite))


def _kepler_distance(speed: float, apocentre: float, t: float) -> float:
    """Distance at the time t on the orbit that starts at its apocentre, by Kepler's equation."""
    axis = 1 / (2 / apocentre - speed**2)
    eccentricity = apocentre / axis - 1
    anomaly = np.pi + t * axis**-1.5
    eccentric = brentq(lambda x: x - eccentricity * np.sin(x) - anomaly, anomaly - 1, anomaly + 1, xtol=1e-15)
    return float(axis * (1 - eccentricity * np.cos(eccentric)))
