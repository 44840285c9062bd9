"""Settings of the fits of the published plants' values."""

from typing import NamedTuple

from dln_jax.control.optimal.fitted import Iteration


class Fit(NamedTuple):
    """Network and iteration of a fit."""

    widths: tuple[int, ...]
    numbers: Iteration
    scale: float = 10.0


FITS = {
    "pendulum": Fit((96, 96, 96), Iteration(iterations=48, starts=1536, kept=6, slope_weight=0.1, floor=0.01)),
    "cart-pole": Fit(
        (96, 96, 96),
        Iteration(
            iterations=80,
            starts=2048,
            kept=6,
            steps=250,
            dt=0.0125,
            seconds=1.5,
            first_memory=0.1,
            memory=5.0,
            slope_weight=0.1,
            floor=0.01,
        ),
    ),
}
"""Settings by plant."""
