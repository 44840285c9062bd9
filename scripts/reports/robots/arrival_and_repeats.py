"""Error rates of two detectors on random motions: stamps of arrival, and recordings of one motion.

Seeds differ from those of the tests, but thresholds were chosen on motions of the same kinds.
"""

import numpy as np

from dln_jax.data.encoders import source_clock
from dln_jax.data.repeated_motions import motion_numbers
from dln_jax.data.schema import Trajectories, from_arrays
from scripts.reports.case import Findings
from scripts.reports.rows import expect

SEED = 30_000
LOGS, SETS, QUICK = 60, 20, 3
"""Numbers of logs, and of sets of motions per kind and number of joints; the last one of either in a quick run."""
RECORDINGS, SAMPLES = 20, 400
"""Numbers of different motions in a set, and of samples of each."""
FOUND, LEFT, FALSE_ALARMS = 0.9, 0.1, 0.02
"""Smallest share of logs whose stamps are replaced, largest error of times relative to the lateness of the stamps, and
largest share of false alarms."""


def arrival(few: bool) -> Findings:
    """Logs of 1 to 7 joints at 60 to 1000 Hz, some rows lost: stamped on time, when measured, or when they arrive."""
    alarms, errors = [], []
    count = QUICK if few else LOGS
    for number in range(count):
        random = np.random.default_rng([SEED, number])
        rate, motion = 10 ** random.uniform(np.log10(60), 3), _sines(random, int(random.integers(1, 8)))
        regular = np.arange(int(random.uniform(15, 40) * rate)) / rate
        lost = regular[random.random(len(regular)) > random.uniform(0, 0.1)]
        uneven = np.sort(regular + random.uniform(-0.2, 0.2, len(regular)) / rate)
        noise = 10 ** random.uniform(-6, -3.7)
        logs = [_log(random, motion(t), t, noise) for t in (regular, lost, uneven)]
        alarms += [source_clock(log) is not None for log in logs]
        late = lost + random.exponential(random.uniform(0.1, 0.5) / rate, len(lost))
        stamps = np.maximum.accumulate(late) + 1e-9 * np.arange(len(late))
        clock = source_clock(_log(random, motion(lost), stamps, noise))
        if clock is not None:
            speed = np.abs(motion(lost)[1]).sum(axis=1)
            moving = speed > 0.5 * speed.mean()
            errors.append(np.std((clock.t - lost)[moving]) / np.std((stamps - lost)[moving]))
    words = f"of {count} logs with stamps of arrival, replaced by the source's times"
    rest = "remaining error of the times over the lateness of the stamps, standard deviations, worst log"
    false = f"of {3 * count} logs with equal steps, lost rows, or rows that were stamped when measured"
    return Findings(
        [
            expect("log-checks/arrival", "found", words, len(errors) / count, FOUND, at_least=True),
            expect("log-checks/arrival", "error_left", rest, max(errors, default=np.inf), LEFT),
            expect("log-checks/arrival", "false_alarms", false, np.mean(alarms), FALSE_ALARMS),
        ]
    )


def repeated_motions(few: bool) -> Findings:
    """Different motions that count as one, and motions whose recordings count as several."""
    kinds = {"Fourier": _fourier, "waypoints": _waypoints, "there and back": _there_and_back, "swings": _swings}
    joined, counts = [], []
    for kind, make in enumerate(kinds.values()):
        for d in (2, 3, 7):
            for number in range(1 if few else SETS):
                random = np.random.default_rng([SEED, kind, d, number])
                joined.append(RECORDINGS - _motions([make(random, d) for _ in range(RECORDINGS)]))
                counts.append(
                    _motions([_again(random, q) for q in (make(random, d) for _ in range(5)) for _ in range(4)])
                )
    different = f"of {len(joined) * RECORDINGS} motions ({', '.join(kinds)}; 2, 3 and 7 joints)"
    share, sets = np.mean(joined) / RECORDINGS, f"of {len(counts)} sets of five motions, recorded four times"
    name = "log-checks/repeated-motions"
    return Findings(
        [
            expect(name, "wrongly_joined", different, share, FALSE_ALARMS),
            expect(name, "found", sets, np.mean(np.array(counts) <= 5), FOUND, at_least=True),
        ]
    )


def _sines(random: np.random.Generator, d: int):
    """Returns t -> q, qd of a sum of four sines in each joint."""
    frequency, phase, size = (random.uniform(low, high, (4, d)) for low, high in ((0.1, 1.5), (0, 6.3), (0.1, 0.5)))

    def motion(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angle = 2 * np.pi * np.multiply.outer(t, frequency) + phase
        return np.sum(size * np.sin(angle), axis=1), np.sum(2 * np.pi * frequency * size * np.cos(angle), axis=1)

    return motion


def _log(
    random: np.random.Generator, motion: tuple[np.ndarray, np.ndarray], stamps: np.ndarray, noise: float
) -> Trajectories:
    """Returns a log with encoder noise, and 1 % of noise in qd."""
    q, qd = motion
    arrays = {"q": q + noise * random.normal(size=q.shape), "qd": qd * (1 + 0.01 * random.normal(size=q.shape))}
    return from_arrays({**arrays, "tau": np.zeros_like(q), "t": stamps, "trajectory": np.zeros(len(q), int)})


def _motions(recordings: list[np.ndarray]) -> int:
    trajectory = np.repeat(np.arange(len(recordings)), [len(q) for q in recordings])
    return len(np.unique(motion_numbers(np.concatenate(recordings), trajectory)))


def _again(random: np.random.Generator, q: np.ndarray) -> np.ndarray:
    """Returns a recording of a motion: from a later start, off by 1 % of its size, with noise."""
    part = q[random.integers(0, SAMPLES // 20) :]
    return part + 0.01 * q.std(axis=0) * random.normal(size=q.shape[1]) + 1e-3 * random.normal(size=part.shape)


def _fourier(random: np.random.Generator, d: int) -> np.ndarray:
    angles = 2 * np.pi * np.multiply.outer(np.linspace(0, 1, SAMPLES), np.arange(1, 6))
    sines, cosines = random.normal(size=(2, 5, d)) / np.arange(1, 6)[:, None]
    return np.sin(angles) @ sines + np.cos(angles) @ cosines


def _through(points: np.ndarray) -> np.ndarray:
    """Returns smooth moves from point to point."""
    place = np.linspace(0, len(points) - 1, SAMPLES)
    first = np.minimum(place.astype(int), len(points) - 2)
    share = (place - first)[:, None]
    share = share**2 * (3 - 2 * share)
    return points[first] * (1 - share) + points[first + 1] * share


def _waypoints(random: np.random.Generator, d: int) -> np.ndarray:
    return _through(random.normal(size=(8, d)))


def _there_and_back(random: np.random.Generator, d: int) -> np.ndarray:
    return _through(np.stack([np.zeros(d), random.normal(size=d), np.zeros(d)]))


def _swings(random: np.random.Generator, d: int) -> np.ndarray:
    """Returns small free oscillations: the modes of one body, with random sizes and phases."""
    modes = np.linalg.qr(np.random.default_rng(5).normal(size=(d, d)))[0]
    t, frequency = np.linspace(0, 8, SAMPLES), 3.0 + 4.0 * np.arange(d)
    return (random.normal(size=d) * np.cos(np.multiply.outer(t, frequency) + random.uniform(0, 6.3, d))) @ modes
