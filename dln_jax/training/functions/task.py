"""Builds a differential network's task from options: the samples of a function and the training method."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from dln_jax.data import functions
from dln_jax.data.functions import FunctionSamples, SampleSplit
from dln_jax.learning.engine.optimisers import GaussNewton, Optimiser, optimiser_named
from dln_jax.learning.functions import GAUSS_NEWTON, WIDTHS, Network, published_adam, targets
from dln_jax.learning.standardisation import Units, own_units, standard_units, to_units
from dln_jax.runs.arguments import resolved
from dln_jax.training.functions.options import AdamOptions, NewtonOptions
from dln_jax.types import InputError, require_seed

NAMED = {
    "sin": (functions.sine, functions.sine_grid),
    "cos_sin": (functions.cosine_sine, functions.cosine_sine_grid),
}
"""Generator and test grid of every named function."""
OF_NAMED = {"samples": 25_600, "noise": 1e-3}
SHARE_OF_DATA = 0.75
"""For ensembles: width of the training box relative to that of the box shown."""


class Task(NamedTuple):
    """A resolved task: samples, network and optimiser."""

    name: str
    sets: SampleSplit
    test: FunctionSamples
    shown: FunctionSamples
    """Samples shown in figures: the test, or a wider grid for an ensemble."""
    bound: float | None
    """Half the width of the training box if the grid shown is wider."""
    units: Units
    network: Network
    optimiser: Optimiser
    grown: bool
    """Whether validation selects the width."""
    remarks: tuple[str, ...] = ()
    """On what is not read of a file."""


def prepare(options: Any) -> Task:
    """Reads and checks everything that the arguments name, before anything is written."""
    require_seed(options.seed)
    remarks = ()
    network, function, several = network_from(options), options.function, options.ensemble > 1
    if function in NAMED:
        generate, grid = NAMED[function]
        bound = np.pi * (SHARE_OF_DATA if several else 1)
        data = generate(**of_named(options), bound=bound, seed=options.seed)
        test, shown, units = grid(bound=bound), grid(), own_units(data)
        bound = bound if several else None
    else:
        if not function.endswith(".npz"):
            raise InputError(f"function '{function}' is unknown; expected sin, cos_sin or an npz file's path")
        everything, remarks = functions.load(function)
        if len(everything.x) < 3:
            raise InputError(f"{function}: {len(everything.x)} samples; training, validation and test need 3")
        data, test = functions.split(everything, seed=options.seed)
        shown, bound, units = test, None, standard_units(data)
    network = network._replace(depth=min(data.inputs, 2) if options.depth is None else options.depth)
    sets = functions.split(data, seed=options.seed)
    optimiser = optimiser_from(options, len(sets.train.x), network.precision)
    targets(to_units(data, units), network)
    grown = options.width is None and isinstance(optimiser, GaussNewton)
    return Task(function, sets, test, shown, bound, units, network, optimiser, grown, remarks)


def of_named(options: Any) -> dict[str, Any]:
    """Settings for drawing the samples of a named function; empty for a file."""
    return resolved(options, OF_NAMED) if options.function in NAMED else {}


def network_from(options: Any) -> Network:
    """The network that the arguments name, with the optimiser's defaults; the depth is set from the data later."""
    newton = options.optimizer == "gauss-newton"
    own = {"width": WIDTHS[0] if newton else 128, "precision": "f64" if newton else "f32", "depth": 1}
    defaults = {key: value for key, value in Network._field_defaults.items() if hasattr(options, key)}
    return Network(**resolved(options, defaults | own), members=options.ensemble)


def optimiser_from(options: Any, samples: int, precision: str) -> Optimiser:
    """The optimiser that the arguments name, for this number of samples."""
    newton = options.optimizer == "gauss-newton"
    names = [field.name for field in dataclasses.fields(NewtonOptions if newton else AdamOptions)]
    stated = {name: value for name in names if (value := getattr(options, name)) is not None}
    own = GAUSS_NEWTON if newton else published_adam(samples, **stated)
    return optimiser_named(options.optimizer, precision=precision, **{**own._asdict(), **stated})
