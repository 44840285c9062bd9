"""Swing-up of the rig's pendulum when samples are late by chance, as on a busy machine, on a clock that is simulated.

Every sample is late by an exponentially distributed time of a given mean, at most 9 ms of a period of 10 ms.
"""

import random
from collections.abc import Callable
from functools import partial

import numpy as np

from dln_jax.control.plants import Plant, hardware_plant
from scripts.reports.case import Findings
from scripts.reports.control import rig
from scripts.reports.control.over_a_socket import ROTARY, learned_and_tried

MEANS = (0.0, 1e-3, 3e-3)
"""Mean delays of samples, s."""
LONGEST, ANSWERING, COMPUTING = 9e-3, 2e-4, 3e-4
"""Largest lateness, and times that an answer and a law take, s."""


def late_plant(mean: float, seed: int) -> Plant:
    """Returns the pendulum, whose reset replaces it by one that hangs near rest."""
    noise = random.Random(seed)
    now, pendulum = [0.0], [rig.Pendulum(noise)]

    def sleep(seconds: float) -> None:
        late = min(noise.expovariate(1 / mean), LONGEST) if mean else 0.0
        now[0] += seconds + late

    def read() -> np.ndarray:
        now[0] += ANSWERING
        return np.array(pendulum[0].seen(now[0]))

    def reset() -> None:
        pendulum[0] = rig.Pendulum(noise, now[0])

    return hardware_plant(
        ROTARY, reset=reset, read=read, write=lambda u: pendulum[0].command(now[0] + COMPUTING, float(u[0])),
        clock=lambda: now[0], sleep=sleep,
    )  # fmt: skip


def with_late_answers(mean: float, quick: bool = False) -> Findings:
    """Explores, learns, tunes and tries."""
    return learned_and_tried(late_plant(mean, 0), f"rig/late-by-{1e3 * mean:g}-ms", 0, 3 if quick else 20)


CASES: dict[str, Callable[[bool], Findings]] = {
    f"rig/late-by-{1e3 * mean:g}-ms": partial(with_late_answers, mean) for mean in MEANS
}
"""Cases of the control report by the mean lateness."""
