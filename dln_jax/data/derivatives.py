"""Time derivatives of sampled trajectories, for data that lack them."""

import numpy as np

from dln_jax.types import InputError


def time_derivative(t: np.ndarray, values: np.ndarray, trajectory: np.ndarray, *, name: str) -> np.ndarray:
    """Second-order finite differences of values [N, d] over t [N], trajectory by trajectory.

    Central inside, one-sided at the ends, any spacing; differences never reach across trajectories.

    Raises:
        InputError: a trajectory has fewer than three samples; `name` is the key that was to be estimated.
    """
    result = np.empty_like(values)
    for index in np.unique(trajectory):
        samples = trajectory == index
        count = int(samples.sum())
        if count < 3:
            raise InputError(
                f"{name} is missing, and trajectory {index} has {count} sample(s): estimating it takes at least 3; "
                f"add {name} or record longer trajectories"
            )
        result[samples] = np.gradient(values[samples], t[samples], axis=0, edge_order=2)
    return result
