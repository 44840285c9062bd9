"""Files of the published Hamiltonian tasks, made by numpy and scipy alone: an independent copy of their protocol.

Greydanus, Dzamba and Yosinski (2019). Keys are those of the schema; q and p carry the published noise, their rates are
exact at the noiseless states, and bodies are ordered axis by axis: x1, x2, .., y1, y2, .. as in the published arrays.

`python -m tests.published_motions FOLDER` writes TASK-SEED.npz files of three seeds, which
`python -m scripts.report hnn --own FOLDER` reads.
"""

import sys
from collections import namedtuple
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

Published = namedtuple("Published", "rates start t noise trajectories")
"""A system, how its motions start, and how they are recorded.

(q, p) [.., d] -> (qd, pd); random generator -> (q, p) [d]; times, standard deviation of
noise, and number of motions.
"""


def _oscillator(force, radii, samples):
    def start(random):
        direction = random.uniform(-1, 1, 2)
        q, p = direction / np.linalg.norm(direction) * random.uniform(*radii)
        return np.array([q]), np.array([p])

    def rates(q, p):
        return 2 * p, force(q)

    return Published(rates, start, np.linspace(0, 3, samples), 0.1, 50)


def _separations(q, bodies):
    """Vectors [.., 2, bodies, bodies] between bodies, and their lengths, infinite from a body to itself."""
    x = q.reshape(*q.shape[:-1], 2, bodies)
    apart = x[..., :, None] - x[..., None, :]
    return apart, np.sqrt(np.sum(apart**2, axis=-3)) + np.diag(np.full(bodies, np.inf))


def _attracting(bodies, start, t, trajectories):
    def rates(q, p):
        apart, distance = _separations(q, bodies)
        return p, -np.sum(apart / distance[..., None, :, :] ** 3, axis=-1).reshape(q.shape)

    return Published(rates, start, t, 0.0, trajectories)


def _two(random):
    x = random.uniform(0.5, 1.5, 2)
    v = np.array([-x[1], x[0]]) / (2 * np.linalg.norm(x) ** 1.5) * (1 + 0.05 * random.normal())
    return np.stack([x, -x], axis=1).ravel(), np.stack([v, -v], axis=1).ravel()


def _three(random):
    direction, radius = random.uniform(-1, 1, 2), random.uniform(0.9, 1.2)
    x = direction / np.linalg.norm(direction) * radius
    v = np.array([-x[1], x[0]]) / radius / np.sqrt(radius * np.sqrt(3))
    cosine, sine = np.cos(2 * np.pi / 3), np.sin(2 * np.pi / 3)
    turn = np.array([[cosine, -sine], [sine, cosine]])
    powers = [np.linalg.matrix_power(turn, k) for k in range(3)]
    q, p = (np.stack([power @ vector for power in powers], axis=1) for vector in (x, v))
    return q.ravel(), (p * (1 + 0.2 * random.uniform(-1, 1, (2, 3)))).ravel()


PUBLISHED = {
    "spring": _oscillator(lambda q: -2 * q, (0.1, 1.0), 30),
    "pendulum": _oscillator(lambda q: -3 * np.sin(q), (1.3, 2.3), 45),
    "two-body": _attracting(2, _two, np.linspace(0, 20, 50), 1000),
    "three-body": _attracting(3, _three, np.linspace(0, 5, 20), 5000),
}


def integrated(system, q, p, t):
    """States (q, p) [K, T, d] at the times t from starts [K, d]."""
    d = q.shape[1]

    def rate(_, state):
        return np.concatenate(system.rates(state[:d], state[d:]))

    options = {"t_eval": t, "rtol": 1e-10, "atol": 1e-12, "method": "DOP853"}
    spans = [solve_ivp(rate, (t[0], t[-1]), np.concatenate(start), **options).y.T for start in zip(q, p, strict=True)]
    states = np.stack(spans)
    return states[..., :d], states[..., d:]


def published_arrays(name, seed, *, trajectories=None):
    """The arrays of a file: t, q, p, qd, pd, trajectory."""
    system, random = PUBLISHED[name], np.random.default_rng(seed)
    count = trajectories or system.trajectories
    starts = [np.stack(each) for each in zip(*(system.start(random) for _ in range(count)), strict=True)]
    q, p = integrated(system, *starts, system.t)
    qd, pd = system.rates(q, p)
    noise = system.noise * random.normal(size=(2, *q.shape))
    arrays = {"q": q + noise[0], "p": p + noise[1], "qd": qd, "pd": pd}
    flat = {key: array.reshape(-1, q.shape[2]) for key, array in arrays.items()}
    times = {"t": np.tile(system.t, count), "trajectory": np.repeat(np.arange(count), len(system.t))}
    return flat | times


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for name in PUBLISHED:
        for seed in (101, 102, 103):
            np.savez(folder / f"{name}-{seed}.npz", **published_arrays(name, seed))
