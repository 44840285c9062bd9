"""Two bodies that nearly meet: the step must shrink or be refused, and gradients stay finite.

On a Kepler orbit of semi-major axis 1 and eccentricity e the distance falls to r = 1 - e. An error of the tolerance
in position there is one of tolerance / r² in energy; a few dozen steps are that near.
"""

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.mechanics.integrators import adaptive_rollout, implicit_midpoint, second_order
from dln_jax.studies.case import Findings
from dln_jax.studies.report import expect, largest

TOLERANCE = 1e-12
STEPS_NEAR = 100
"""Steps whose errors may add up at the nearest point."""
NEAREST = 1e-3
"""Semi-major axis 1, eccentricity 0.999."""


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
    wrong = refused = 0
    for index, dt in enumerate(np.asarray(dts)):
        end = [np.asarray(leaf[index]) for leaf in ends]
        if not all(np.isfinite(leaf).all() for leaf in end):
            refused += 1
            continue
        rates = field(0.0, tuple((first + last) / 2 for first, last in zip(start, end, strict=True)))
        for first, last, rate in zip(start, end, rates, strict=True):
            change = dt * np.asarray(rate)
            wrong += bool(abs(last - first - change).max() > 1e-9 * (1 + abs(change).max()))
    return wrong, refused


def _kepler_distance(speed: float, apocentre: float, t: float) -> float:
    """Distance at the time t on the orbit that starts at its apocentre: Kepler's equation, by bisection."""
    axis = 1 / (2 / apocentre - speed**2)
    eccentricity = apocentre / axis - 1
    anomaly = np.pi + t * axis**-1.5
    low, high = anomaly - 1.0, anomaly + 1.0
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if middle - eccentricity * np.sin(middle) < anomaly else (low, middle)
    return axis * (1 - eccentricity * np.cos(low))
