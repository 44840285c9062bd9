"""Shares a training between devices: splits several seeds over them, or the samples of one seed."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jax.sharding import Mesh

from dln_jax.learning.engine.problem import Problem
from dln_jax.scale.mesh import on_devices, spread
from dln_jax.types import InputError


class Sharing(NamedTuple):
    """Meshes that split the seeds or the samples; at most one of them."""

    seeds: Mesh | None
    """Every device trains its own seeds, as on its own: only results are sent. Some devices may have one seed more."""
    samples: Mesh | None
    """Every device sums over its own samples; every step adds up the sums."""


def sharing(problem: Problem, mesh: Mesh | None) -> Sharing:
    """Returns what the devices of a mesh share in this problem: seeds or samples.

    Raises:
        InputError: one seed, with a loss that is not the mean of the losses of parts of a batch.
    """
    if mesh is None or np.size(problem.seed) > 1:
        return Sharing(mesh, None)
    if problem.loss is not None and not problem.loss_is_mean:
        raise InputError("the loss is of a whole batch, whose samples cannot be split: train it on one device")
    return Sharing(None, mesh)


def by_devices(function: Callable[[Any, Any], Any], shared: Sharing) -> Callable[[Any, Any], Any]:
    """Distributes a function of (whole, seeds): every device evaluates it for its own seeds.

    Devices that share the samples work on all seeds together, and the function itself adds up their sums.
    """
    together = on_devices(lambda given, _: function(*given), shared.samples)
    return spread(lambda whole, seeds: together((whole, seeds), None), shared.seeds)
