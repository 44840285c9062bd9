"""Options of train_diffnet. Importing them does not import JAX."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from dln_jax.runs.arguments import Unstated, Variants, choice
from dln_jax.runs.options import Drawn, Resumable, Scaled

NAMES = ("sin", "cos_sin")
"""Functions with the published noise."""


@dataclass(frozen=True)
class Learned:
    """The function to learn, and the network."""

    function: Annotated[str, choice((*NAMES, "FILE.npz"))] = "sin"
    """Function to learn; an npz file has x [N, n], y [N, m], optional dy [N, m, n] and d2y [N, m, n, n]."""
    loss: Literal["type1", "type2"] = "type1"
    """type1 fits value and gradient, type2 the value only."""
    activation: Annotated[
        str, choice(("relu", "softplus", "tanh", "cos", "sin", "silu", "gelu", "linear", "quadratic", "cubic"))
    ] = "cos"
    """Activation of the hidden layers."""
    derivative: Literal[1, 2] = 1
    """2 adds the Hessian to the loss."""
    ensemble: int = 1
    """Number of networks; several learn sin and cos_sin on ±0.75 π and are shown on ±π."""
    optimizer: Literal["adam", "gauss-newton"] = "gauss-newton"
    """Levenberg-Marquardt for small networks, or Adam, the published recipe, for wide ones."""
    width: Unstated[int] = None
    """Hidden units per layer (default: 128 for adam; for gauss-newton grown from 2 to 16 by validation)."""
    depth: Unstated[int] = None
    """Hidden layers (default: 1 for one input, else 2)."""
    precision: Unstated[Literal["f32", "f64"]] = None
    """Floating-point type (default: f64 for gauss-newton, which needs it, f32 for adam)."""
    seed: int = 0
    """Seed of data, validation split, parameters and shuffling."""


@dataclass(frozen=True)
class Options(Drawn, Scaled, Resumable, Learned):
    """What to train on, how, and where the results go."""


@dataclass(frozen=True)
class NewtonOptions:
    """Gauss-Newton."""

    steps: Unstated[int] = None
    """Iterations on all samples per network (default: at most 40)."""
    coarse_steps: Unstated[int] = None
    """Earlier iterations on 2,048 of the samples (default: at most 200; 0 for none)."""


@dataclass(frozen=True)
class AdamOptions:
    """Adam."""

    epochs: Unstated[int] = None
    """Passes over the data (default: 500)."""
    batch: Unstated[int] = None
    """Samples per step (default: 512)."""
    learning_rate: Unstated[float] = None
    """Constant learning rate (default: 0.001)."""
    weight_decay: Unstated[float] = None
    """Decoupled weight decay (default: 0.000001)."""


@dataclass(frozen=True)
class SampledOptions:
    """Samples of a named function."""

    samples: Unstated[int] = None
    """Number of samples to draw (default: 25600)."""
    noise: Unstated[float] = None
    """Standard deviation of the noise on x, f, gradient and Hessian (default: 0.001)."""


def options_of(stated: Mapping[str, Any]) -> tuple[type, ...]:
    """Options of the optimiser and of a named function."""
    named = (SampledOptions,) if stated["function"] in NAMES else ()
    return (*named, AdamOptions if stated["optimizer"] == "adam" else NewtonOptions)


VARIANTS = Variants(
    options_of,
    {
        NewtonOptions: "--optimizer gauss-newton",
        AdamOptions: "--optimizer adam",
        SampledOptions: "--function sin and cos_sin",
    },
)
