"""Verdicts of train_hnn_task on files of motions: sound plants must be good, and plants that no model describes not.

Motions are integrated by SciPy and fitted by the command, from a file with nothing but the stated columns.
"""

import contextlib
import io
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from dln_jax.cli.arguments import arguments_of
from dln_jax.cli.commands import train_hnn_task
from dln_jax.errors import FitRefused
from dln_jax.files import read_json
from scripts.reports.case import Case, Findings
from scripts.reports.rows import expect

MOTIONS = 12
"""Recordings per file."""
Rates = Callable[[float, np.ndarray], np.ndarray]


class Plant(NamedTuple):
    """A plant, how it is recorded, and the verdict that its model deserves."""

    rates: Rates
    """t and (q, p) of all coordinates -> their rates."""
    start: Callable[[np.random.Generator], Sequence[float] | np.ndarray]
    t: np.ndarray
    joints: tuple[str, ...]
    good: bool
    """Whether the verdict must be good; otherwise it must not."""
    keys: str = "q"
    """Columns of the file: of q, p (momenta), r (their rates), v (velocities)."""
    noise: float = 0.0
    """Of q and p."""
    friction: bool = False


def oscillator(force: Callable[[float, float, float], float]) -> Rates:
    """Rates of a unit mass under force(t, q, qd)."""
    return lambda t, x: np.array([x[1], force(t, x[0], x[1])])


def double_pendulum(t: float, x: np.ndarray) -> np.ndarray:
    """Two equal points on rods of 1 m, by angles from the vertical and their velocities."""
    (a, b), (va, vb), c = x[:2], x[2:], np.cos(x[0] - x[1])
    s, g = np.sin(a - b), 9.81
    push = np.array([-s * vb**2 - 2 * g * np.sin(a), s * va**2 - g * np.sin(b)])
    return np.concatenate([x[2:], np.linalg.solve([[2, c], [c, 1]], push)])


def kepler(t: float, x: np.ndarray) -> np.ndarray:
    """A body of unit mass about a centre."""
    return np.concatenate([x[2:], -x[:2] / np.linalg.norm(x[:2]) ** 3])


def orbit(random: np.random.Generator) -> list[float]:
    """A start at the nearest point of an orbit with an eccentricity of 0.4 to 0.6 and a half-axis of 1."""
    e, angle = random.uniform(0.4, 0.6), random.uniform(0, 2 * np.pi)
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    return [*((1 - e) * along), *(np.sqrt((1 + e) / (1 - e)) * across)]


def bodies(t: float, x: np.ndarray) -> np.ndarray:
    """Two bodies of unit mass in a plane: x1, y1, x2, y2."""
    apart = x[:2] - x[2:4]
    pull = apart / np.linalg.norm(apart) ** 3
    return np.concatenate([x[4:], -pull, pull])


def pair(random: np.random.Generator) -> np.ndarray:
    """A start of two bodies on nearly circular orbits."""
    x = random.uniform(0.5, 1.5, 2)
    v = np.array([-x[1], x[0]]) / (2 * np.linalg.norm(x) ** 1.5) * (1 + 0.05 * random.normal())
    return np.concatenate([x, -x, v, -v])


def times(seconds: float | int, rate: float | int) -> np.ndarray:
    """Times of a recording."""
    return np.arange(0.0, seconds, 1 / rate)


def swing(random: np.random.Generator) -> list[float]:
    """A start from rest."""
    return [random.uniform(-2.5, 2.5), 0.0]


def anywhere(random: np.random.Generator) -> list[float]:
    """A start with a velocity."""
    return random.uniform(-1.5, 1.5, 2).tolist()


SPRING = oscillator(lambda t, q, v: -4 * q)
PENDULUM = oscillator(lambda t, q, v: -9.81 * np.sin(q))
DAMPED = oscillator(lambda t, q, v: -9.81 * np.sin(q) - 0.2 * v)
DUFFING = oscillator(lambda t, q, v: q - q**3 - 0.3 * v + 0.5 * np.cos(1.2 * t))
SLIDE, TURN = ("prismatic",), ("revolute",)


def prey(t: float, x: np.ndarray) -> np.ndarray:
    """Lotka and Volterra's equations, which are no Hamiltonian ones in these coordinates."""
    return np.array([x[0] * (1 - x[1]), -x[1] * (1 - x[0])])


def animals(random: np.random.Generator) -> np.ndarray:
    """Numbers of prey and predators."""
    return random.uniform(0.3, 2.0, 2)


def tumble(random: np.random.Generator) -> np.ndarray:
    """A start of the double pendulum from rest."""
    return np.concatenate([random.uniform(-2.0, 2.0, 2), np.zeros(2)])


PLANTS = {
    "spring": Plant(SPRING, anywhere, times(8, 50), SLIDE, True),
    "spring-momenta": Plant(SPRING, anywhere, times(8, 20), SLIDE, True, "qpr"),
    "spring-noisy-momenta": Plant(SPRING, anywhere, times(6, 20), SLIDE, True, "qpr", 0.1),
    "pendulum": Plant(PENDULUM, swing, times(6, 100), TURN, True),
    "pendulum-coarse": Plant(PENDULUM, swing, times(12, 5), TURN, True),
    "pendulum-noise": Plant(PENDULUM, swing, times(6, 50), TURN, True, "q", 0.02),
    "pendulum-fast-noise": Plant(PENDULUM, swing, times(5, 400), TURN, True, "q", 0.01),
    "damped-pendulum": Plant(DAMPED, swing, times(8, 50), TURN, True, "qv", friction=True),
    "two-bodies": Plant(bodies, pair, times(20, 2.5), 4 * SLIDE, True, "qpr"),
    "lotka-volterra": Plant(prey, animals, times(13.5, 20), SLIDE, False, "qpr"),
    "lotka-volterra-states": Plant(prey, animals, times(13.5, 20), SLIDE, False, "qp"),
    "forced-duffing": Plant(DUFFING, anywhere, times(15, 100), SLIDE, False, friction=True),
    "kepler-as-joints": Plant(kepler, orbit, times(11.4, 20), 2 * TURN, False),
    "one-angle-of-two": Plant(double_pendulum, tumble, times(7.4, 50), TURN, False),
    "random-walk": Plant(lambda t, x: 0 * x, anywhere, times(7.4, 50), SLIDE, False),
}
"""Plants by name; the random walk has no rates."""


def recorded(name: str, plant: Plant, seed: int) -> dict[str, Any]:
    """Arrays of a file."""
    random, states, d = np.random.default_rng([seed, len(name)]), [], len(plant.joints)
    for _ in range(MOTIONS):
        start = plant.start(random)
        solved = solve_ivp(plant.rates, (0, plant.t[-1]), start, "DOP853", plant.t, rtol=1e-9, atol=1e-9)
        states.append(solved.y.T)
    if name == "random-walk":
        states = [np.cumsum(0.1 * random.normal(size=state.shape), axis=0) for state in states]
    every, count = np.concatenate(states), len(plant.t)
    rates = np.array([plant.rates(t, x) for t, x in zip(np.tile(plant.t, MOTIONS), every, strict=True)])
    half = every.shape[1] // 2
    noise = plant.noise * random.normal(size=every.shape)
    columns = {
        "q": {"q": (every + noise)[:, :d]},
        "p": {"p": (every + noise)[:, half : half + d]},
        "v": {"qd": every[:, half : half + d]},
        "r": {"qd": rates[:, :d], "pd": rates[:, half : half + d]},
    }
    arrays = {"t": np.tile(plant.t, MOTIONS), "trajectory": np.repeat(np.arange(MOTIONS), count)}
    return arrays | {key: array for kind in plant.keys for key, array in columns[kind].items()}


def verdict_of(name: str, seed: int) -> str:
    """The verdict that the command stores in its run folder."""
    plant = PLANTS[name]
    friction = ', "friction": true' if plant.friction else ""
    needs = f'{{"joints": {list(plant.joints)}, "gravity": true{friction}}}'.replace("'", '"')
    with tempfile.TemporaryDirectory(prefix="dln_jax-") as temporary:
        folder = Path(temporary)
        np.savez(folder / "motions.npz", **recorded(name, plant, seed))
        stated = {"data": folder / "motions.npz", "out": folder / "run", "figures": False, "low_latency": False}
        with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(FitRefused):
            train_hnn_task.main(arguments_of(train_hnn_task.Arguments, task="measured", needs=needs, **stated))
        return read_json(folder / "run" / "config.json", remedy="measure again")["chosen"]["verdict"]["level"]


def findings(name: str, files: int, seed: int) -> Findings:
    """Share of wrong verdicts: sound plants that are not good, or others that are."""
    good = [verdict_of(name, seed + number) == "good" for number in range(files)]
    wrong = float(np.mean(np.array(good) != PLANTS[name].good))
    expected = "sound plants are good" if PLANTS[name].good else "no model describes it: at least doubtful"
    return Findings([expect(f"motions/{name}", "wrong_share", expected, wrong, 0.0)])


def cases(files: int, seed: int) -> list[Case]:
    """One case per plant."""
    return [Case(f"motions/{name}", partial(findings, name, files, seed)) for name in PLANTS]
