"""Builds a differential network's task from options: the samples of a function and the training method."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from dln_jax.cli.arguments import Unstated, choice, refuse_given, resolved
from dln_jax.cli.optimisers import optimiser_named
from dln_jax.cli.options import Drawn, Resumable, Scaled
from dln_jax.data import functions
from dln_jax.data.functions import FunctionSamples, SampleSplit
from dln_jax.learning.engine.optimisers import GaussNewton, Optimiser
from dln_jax.learning.functions import GAUSS_NEWTON, LOSSES, WIDTHS, Network, published_adam, targets
from dln_jax.learning.standardisation import Units, own_units, standard_units, to_units
from dln_jax.nn.activations import ALL
from dln_jax.types import InputError, require_seed

NAMED = {
    "sin": (functions.sine, functions.sine_grid),
    "cos_sin": (functions.cosine_sine, functions.cosine_sine_grid),
}
"""Generator and test grid of every named function."""
OF_NAMED = {"samples": 25_600, "noise": 1e-3}
OF_ADAM = ("epochs", "batch", "learning_rate", "weight_decay")
OF_NEWTON = ("steps", "coarse_steps")
SHARE_OF_DATA = 0.75
"""For ensembles: width of the training box relative to that of the box shown."""


@dataclass(frozen=True)
class Options(Resumable, Drawn, Scaled):
    """What to train on, how, and where the results go."""

    function: Annotated[str, choice((*NAMED, "FILE.npz"))] = "sin"
    """sin, cos_sin, or the path of an npz file with x [N, n], y [N, m], optional dy [N, m, n] and d2y [N, m, n, n]."""
    loss: Annotated[str, choice(LOSSES)] = "type1"
    """type1 fits value and gradient, type2 the value only."""
    activation: Annotated[str, choice(ALL)] = "cos"
    """Of the hidden layers."""
    derivative: Literal[1, 2] = 1
    """2 adds the Hessian to the loss."""
    ensemble: int = 1
    """Networks; with more than one, sin and cos_sin are trained on ±0.75 π and shown on ±π."""
    optimizer: Literal["adam", "gauss-newton"] = "gauss-newton"
    """Levenberg-Marquardt on all samples (f64) for small networks, or Adam, the published recipe, for wide ones."""
    width: Unstated[int] = None
    """Hidden units per layer (default: 128 for adam; for gauss-newton grown, 2, 4, 8, 16, until the validation error
    no longer falls)."""
    depth: Unstated[int] = None
    """Hidden layers (default: 1 for one input, else 2)."""
    steps: Unstated[int] = None
    """Gauss-Newton: iterations on all samples at most, per network (default: 40)."""
    coarse_steps: Unstated[int] = None
    """Gauss-Newton: iterations before those, at most, on 2,048 of the samples where there are twice as many (default:
    200; 0 for none)."""
    epochs: Unstated[int] = None
    """Adam: passes over the data (default: 500)."""
    batch: Unstated[int] = None
    """Adam: samples per step (default: 512)."""
    learning_rate: Unstated[float] = None
    """Adam: constant rate (default: 0.001)."""
    weight_decay: Unstated[float] = None
    """Adam: decoupled weight decay (default: 0.000001)."""
    samples: Unstated[int] = None
    """Samples of sin and cos_sin (default: 25600)."""
    noise: Unstated[float] = None
    """Their standard deviation of the noise on x, f, gradient and Hessian (default: 0.001)."""
    precision: Unstated[Literal["f32", "f64"]] = None
    """Floating-point type (default: f64 for gauss-newton, which needs it, f32 for adam)."""
    seed: int = 0
    """Of the data, the validation split, the initial parameters and the shuffling; 0 to 4294967295."""


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


def prepare(given: Options) -> Task:
    """Reads and checks everything that the arguments name, before anything is written."""
    require_seed(given.seed)
    network, function, several = network_from(given), given.function, given.ensemble > 1
    if function in NAMED:
        generate, grid = NAMED[function]
        bound = np.pi * (SHARE_OF_DATA if several else 1)
        data = generate(**of_named(given), bound=bound, seed=given.seed)
        test, shown, units = grid(bound=bound), grid(), own_units(data)
        bound = bound if several else None
    else:
        if not function.endswith(".npz"):
            raise InputError(f"function '{function}' is unknown; expected sin, cos_sin or an npz file's path")
        refuse_given(given, OF_NAMED, "for sin and cos_sin, not for a file")
        everything = functions.load(function)
        if len(everything.x) < 3:
            raise InputError(f"{function}: {len(everything.x)} samples; training, validation and test need 3")
        data, test = functions.split(everything, seed=given.seed)
        shown, bound, units = test, None, standard_units(data)
    network = network._replace(depth=min(data.inputs, 2) if given.depth is None else given.depth)
    sets = functions.split(data, seed=given.seed)
    optimiser = optimiser_from(given, len(sets.train.x), network.precision)
    targets(to_units(data, units), network)
    grown = given.width is None and isinstance(optimiser, GaussNewton)
    return Task(function, sets, test, shown, bound, units, network, optimiser, grown)


def of_named(given: Options) -> dict[str, Any]:
    """Settings for drawing the samples of a named function; empty for a file."""
    return resolved(given, OF_NAMED) if given.function in NAMED else {}


def network_from(given: Options) -> Network:
    """The network that the arguments name, with the optimiser's defaults; the depth is set from the data later."""
    newton = given.optimizer == "gauss-newton"
    own = {"width": WIDTHS[0] if newton else 128, "precision": "f64" if newton else "f32", "depth": 1}
    defaults = {key: value for key, value in Network._field_defaults.items() if hasattr(given, key)}
    return Network(**resolved(given, defaults | own), members=given.ensemble)


def optimiser_from(given: Options, samples: int, precision: str) -> Optimiser:
    """The optimiser that the arguments name, for this number of samples."""
    newton = given.optimizer == "gauss-newton"
    refuse_given(given, *((OF_ADAM, "for adam: add --optimizer adam") if newton else (OF_NEWTON, "for gauss-newton")))
    stated = {name: value for name in (*OF_ADAM, *OF_NEWTON) if (value := getattr(given, name)) is not None}
    own = GAUSS_NEWTON if newton else published_adam(samples, **stated)
    return optimiser_named(given.optimizer, precision=precision, **{**own._asdict(), **stated})
