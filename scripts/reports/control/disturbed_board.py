"""The board's plant with the disturbances of its robustness table, one at a time (version 2 of that table).

Numbers are those of the board's own program (`leaderboard/acrobot/robustness_v2` of Wiebe et al. 2022, and its
`analysis/benchmark.py`). The disturbances take 21 values:

    ten parameters of the plant; the controller assumes their nominal values
    the standard deviation of the noise on measured rates, 0 to 0.5 rad/s; more than half of ten runs must succeed
    the standard deviation of the noise on torques, 0 to 1.1 N m; likewise
    the response k of the motor, u_k = u_{k-1} + k (wanted - u_{k-1}), 0.1 to 2
    the delay of all measurements, 0 to 40 ms

In 50 further runs the joints get three random pushes each. The board's plant multiplies all torques by B, including
pushes, so pushes on the passive joint have no effect. As on the board, a run succeeds if its last state is near the
goal. A criterion is the share of successes, and the score the mean of the six criteria.
"""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.control import Controller, error, saturated
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.integrators import CLASSICAL, runge_kutta
from dln_jax.scenes.pendulums import Links, two_link_pendulum
from scripts.reports.control.board import GOAL, LIMIT, RATE, SECONDS, Motor, plant

VALUES, REPETITIONS, PUSHED = 21, 10, 50
NEAR = np.array([0.35, 0.35, 1.0, 1.0])
"""Tolerance of the last state of a successful run, rad and rad/s."""
LONGEST = 20
"""Longest delay in samples."""
GEAR = 6.0
"""Gear ratio between a rotor and its joint."""
SPREAD = 0.25
"""Relative range of masses, centres and inertias, to either side."""
VISCOUS, DRY, ROTOR = 0.1, 0.2, 1e-4
"""Largest viscous and dry friction (of either sign), N m s and N m, and largest rotor inertia, kg m²."""
RATES_NOISE, TORQUE_NOISE, SLOWEST, FASTEST = 0.5, 1.1, 0.1, 2.0
APART, WIDTHS, PUSHES = 1.0, (0.05, 0.1), (0.5, 5.0)
"""Time between successive pushes, s, range of their standard deviations, s, and range of their torques, N m."""
TOGETHER = 105
"""Runs per program call."""
CRITERIA = ("model", "rate_noise", "torque_noise", "response", "delay", "pushes")


class Disturbance(NamedTuple):
    """Differences from the nominal plant."""

    links: Links
    rotor: Any
    """Rotor inertia of the motors, kg m²."""
    viscous: Any
    """Viscous friction [2], N m s."""
    dry: Any
    """Dry friction [2], N m, by the law arctan(100 qd)."""
    rate_noise: Any
    """Standard deviation of the noise on measured rates, rad/s."""
    torque_noise: Any
    """Standard deviation of the noise on torques, N m."""
    response: Any
    delay: Any
    """Delay of measurements in samples."""
    times: Any
    """Times of the pushes by joint [2, P], s."""
    widths: Any
    """Standard deviations of the pushes in time [2, P], s."""
    pushes: Any
    """Peak torques of the pushes [2, P], N m."""


def undisturbed() -> Disturbance:
    """The nominal plant."""
    none = np.zeros(2)
    return Disturbance(Links(), 0.0, none, none, 0.0, 0.0, 1.0, 0, np.zeros((2, 3)), np.ones((2, 3)), np.zeros((2, 3)))


def disturbances(seed: int = 0) -> dict[str, list[Disturbance]]:
    """All disturbances of the table by criterion; values of noise repeat ten times, and pushes are random."""
    base, random = undisturbed(), np.random.default_rng(seed)
    factors = np.linspace(1 - SPREAD, 1 + SPREAD, VALUES)
    model = [base._replace(rotor=inertia) for inertia in np.linspace(0, ROTOR, VALUES)]
    # Two of the board's parameters are products; one factor varies, and the inertias about the joints stay.
    of_links = (("centres", 0), ("inertias", 0), ("centres", 1), ("masses", 1), ("inertias", 1))
    model += [base._replace(links=_scaled(*which, factor)) for which in of_links for factor in factors]
    for key, most in (("viscous", VISCOUS), ("dry", DRY)):
        signed = np.linspace(-most, most, VALUES)
        model += [base._replace(**{key: friction * unit}) for unit in np.eye(2) for friction in signed]
    noise = lambda key, most: [  # noqa: E731
        base._replace(**{key: size}) for size in np.linspace(0, most, VALUES) for _ in range(REPETITIONS)
    ]
    return {
        "model": model,
        "rate_noise": noise("rate_noise", RATES_NOISE),
        "torque_noise": noise("torque_noise", TORQUE_NOISE),
        "response": [base._replace(response=k) for k in np.linspace(SLOWEST, FASTEST, VALUES)],
        "delay": [base._replace(delay=samples) for samples in range(LONGEST + 1)],
        "pushes": [_pushed(random) for _ in range(PUSHED)],
    }


def _scaled(key: str, link: int, factor: float) -> Links:
    links = Links()
    values = [value * factor if n == link else value for n, value in enumerate(getattr(links, key))]
    return links._replace(**{key: tuple(values)})


def _pushed(random: np.random.Generator) -> Disturbance:
    """Three random pushes at each joint, all at least a second apart."""
    count = 6
    room = (SECONDS - (count + 1) * APART) / count
    times = random.permutation(np.cumsum(APART + random.uniform(0, room, count))).reshape(2, 3)
    least, most = PUSHES
    drawn = random.uniform(least - most, most - least, (2, 3))
    widths = random.uniform(*WIDTHS, (2, 3))
    return undisturbed()._replace(times=times, widths=widths, pushes=drawn + least * np.sign(drawn))


def disturbed(motor: Motor, disturbance: Disturbance) -> Callable[[Array, Array], Array]:
    """(x, torques of both joints) -> dx/dt of the disturbed plant."""
    system = dynamics(two_link_pendulum(motor, links=disturbance.links).closed_form)
    rotor = jnp.asarray(disturbance.rotor) * jnp.array([[GEAR**2 + 1, -GEAR], [-GEAR, GEAR**2]])

    def field(x: Array, tau: Array) -> Array:
        q, qd = jnp.split(x, 2)
        friction = disturbance.viscous * qd + disturbance.dry * jnp.arctan(100 * qd)
        held = system.inverse_dynamics(q, qd, jnp.zeros(2)) + friction
        # Cramer's rule: a factorisation of a 2 x 2 matrix would cost more than the rest.
        (a, b), (_, d) = system.mass_matrix(q) + rotor
        f, g = tau - held
        return jnp.concatenate([qd, jnp.stack([d * f - b * g, a * g - b * f]) / (a * d - b * b)])

    return field


def last_state(motor: Motor, controller: Controller, disturbance: Disturbance, key: Array) -> Float[Array, "4"]:
    """The state after ten seconds from hanging; the controller gets measured (q, qd)."""
    B, dt = plant(motor)[1], 1.0 / RATE
    field = disturbed(motor, disturbance)

    def sample(carry: tuple, number: Array) -> tuple[tuple, None]:
        history, memory, before = carry
        of_rates, of_torque = jax.random.split(jax.random.fold_in(key, number))
        y = history[jnp.asarray(disturbance.delay)]
        y = y.at[2:].add(disturbance.rate_noise * jax.random.normal(of_rates, (2,)))
        memory, wanted = controller.act(memory, number * dt, y)
        u = before + disturbance.response * (wanted - before)
        u = saturated(u + disturbance.torque_noise * jax.random.normal(of_torque, (1,)), -LIMIT, LIMIT)
        since = (number * dt - disturbance.times) / disturbance.widths
        pushed = B.T @ jnp.sum(disturbance.pushes * jnp.exp(-(since**2) / 2), axis=1)
        tau = B @ (u + pushed)
        x = runge_kutta(CLASSICAL, lambda t, state: field(state, tau))(0.0, history[0], dt)
        return (jnp.concatenate([x[None], history[:-1]]), memory, u), None

    start = (jnp.zeros((LONGEST + 1, 4)), controller.start, jnp.zeros(1))
    (history, _, _), _ = jax.lax.scan(sample, start, jnp.arange(round(SECONDS * RATE)))
    return history[0]


def successes(motor: Motor, controller: Controller, all_of: list[Disturbance], seed: int = 0) -> np.ndarray:
    """Whether the runs end near the goal; False for a run that diverges to NaN."""
    count, joints = len(all_of), plant(motor)[0].needs.joints
    keys = jax.random.split(jax.random.key(seed), count)
    run = jax.jit(jax.vmap(lambda disturbance, key: last_state(motor, controller, disturbance, key)))
    ends = []
    # Neighbours are similar, so a controller that waits for a delay does not hold up very different runs.
    for first in range(0, count, TOGETHER):
        places = np.minimum(np.arange(first, first + TOGETHER), count - 1)
        chunk = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *(all_of[place] for place in places))
        ends.append(np.asarray(run(chunk, keys[places])))
    off = np.abs(jax.vmap(lambda x: error(x, GOAL, joints))(jnp.asarray(np.concatenate(ends)[:count])))
    # NaN compares as False, hence as a failure.
    return np.all(off < NEAR, axis=1)


def robustness(motor: Motor, controller: Controller, seed: int = 0, *, every: int = 1) -> dict[str, float]:
    """The share of successes by criterion, and their mean; uses one in `every` disturbances, for a quick look."""
    table = {name: listed[::every] for name, listed in disturbances(seed).items()}
    ends_well = successes(motor, controller, list(itertools.chain(*table.values())), seed)
    ends = np.cumsum([len(listed) for listed in table.values()])
    shares = {}
    for name, good in zip(table, np.split(ends_well, ends[:-1]), strict=True):
        repeated = name.endswith("noise") and every == 1
        often = good.reshape(-1, REPETITIONS).mean(axis=1) > 0.5 if repeated else good
        shares[name] = float(np.mean(often))
    return {**shares, "mean": float(np.mean(list(shares.values())))}
