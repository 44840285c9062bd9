"""How devices share a training: several seeds are split over them, and of one the samples."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jax.sharding import Mesh

from dln_jax.learning.engine.problem import Problem
from dln_jax.scale.mesh import on_devices, spread
from dln_jax.types import InputError


class Sharing(NamedTuple):
    """What is split over a mesh; one of both at most."""

    seeds: Mesh | None
    """Each device trains its own, as it would alone: nothing is sent but the results. Some may have one more."""
    samples: Mesh | None
    """Each device sums over its own, and the sums are added up in every step."""


def sharing(problem: Problem, mesh: Mesh | None) -> Sharing:
    """What the devices of a mesh share of a problem.

    Raises:
        InputError: one seed, of a loss that is not the mean of those of parts of a batch.
    """
    if mesh is None or np.size(problem.seed) > 1:
        return Sharing(mesh, None)
    if problem.loss is not None and not problem.loss_is_mean:
        raise InputError("the loss is of a whole batch, whose samples cannot be split: train it on one device")
    return Sharing(None, mesh)


def by_devices(function: Callable[[Any, Any], Any], shared: Sharing) -> Callable[[Any, Any], Any]:
    """The same function of what is whole and what the seeds have, each device for its seeds.

    Devices that share the samples work at all seeds together, and the function itself brings their sums together.
    """
    together = on_devices(lambda given, _: function(*given), shared.samples)
    return spread(lambda whole, seeds: together((whole, seeds), None), shared.seeds)
