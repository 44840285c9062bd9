"""Options of the commands that train dynamics, for every model and for each way of fitting.

Importing this module does not import JAX, so that `--help` is quick.
"""

import dataclasses
import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from dln_jax.runs.arguments import Unstated, Variants
from dln_jax.runs.options import Devices, Drawn, Filtered, Limited, Resumable, Scaled

ActivationName = Literal["tanh", "softplus", "silu", "gelu", "sin", "cos"]
Precision = Literal["f32", "f64"]
NETWORK, AUTO = "structured-delan", "auto"
"""Default model for the embedded data; model selection, the default for files."""


@dataclass(frozen=True)
class Plant:
    """Model and data."""

    model: str | None = None
    """Model to learn."""
    data: Unstated[Path] = None
    """Trajectories, npz, CSV or ROS bag (default: the embedded letters, or states of --scene)."""
    test: Unstated[str] = None
    """Test trajectories: comma-separated labels; last:30% for the end of every trajectory; or blocks, for ten blocks of
    time in each (default: e,q,v, else every sixth, else blocks of time)."""
    scene: Unstated[str] = None
    """Textbook scene that states the needs of the data, such as cart-pole or chain-3; sampled if there is no --data."""
    needs: Unstated[str] = None
    """Joints and terms of the plant, such as '{"joints": ["revolute"], "friction": true}' (default: those of the scene
    or file, else revolute joints, gravity and friction)."""
    velocity_scale: Unstated[float] = None
    """Dry friction is smooth below this velocity, rad/s or m/s (default: 0.01)."""
    seed: int = 0
    """Seed of parameters, shuffling and validation split."""


@dataclass(frozen=True)
class Options(Drawn, Resumable, Filtered, Plant):
    """What to train on, and where the results go."""

    uncertainty: bool = True
    """Estimate the uncertainty of the torques, and flag states out of distribution."""


@dataclass(frozen=True)
class Objective:
    """Precision and objective of a fit."""

    precision: Unstated[Precision] = None
    """Floating-point type (default: f64; f32 for adam)."""
    objective: Unstated[Literal["inverse", "forward", "both"]] = None
    """Errors to minimise: torques, accelerations or both (default: inverse; feed-forward: both)."""


@dataclass(frozen=True)
class NetworkOptions(Objective, Limited, Scaled):
    """A network and its training."""

    optimizer: Literal["auto", "adam", "gauss-newton"] = "auto"
    """gauss-newton is far more accurate for small networks."""
    width: Unstated[int] = None
    """Hidden units per layer (default: structured 8, others 16, adam 64; chosen from the data for 4 joints or more)."""
    depth: Unstated[int] = None
    """Hidden layers (default: 2)."""
    activation: Unstated[ActivationName] = None
    """Activation of the hidden layers (default: tanh)."""
    steps: Unstated[int] = None
    """Iterations (default: structured 150, others 400, adam 20000; for 4 joints or more 40 and 6000)."""
    seeds: int = 1
    """Number of seeds in one program; the best in cross-validation is kept."""
    folds: int = 3
    """Folds of the cross-validation over seeds (1: use the validation motions alone)."""


@dataclass(frozen=True)
class AdamOptions:
    """Adam."""

    batch: Unstated[int] = None
    """Samples per step (default: 512)."""
    learning_rate: Unstated[float] = None
    """Peak of the warm-up and cosine schedule (default: 0.005)."""
    weight_decay: Unstated[float] = None
    """Decoupled weight decay (default: 0.00001)."""
    patience: Unstated[int] = None
    """Stop after this many steps without improvement of the validation error (default: 10000)."""


@dataclass(frozen=True)
class GaussNewtonOptions:
    """Levenberg-Marquardt."""

    samples: Unstated[int] = None
    """Number of training samples to draw and fit (default: all; for 4 joints or more, 14 equations per parameter)."""


@dataclass(frozen=True)
class GrownOptions:
    """A structured network that grows."""

    target: Unstated[float] = None
    """Validation error, (N m)² or N²: grow the network until it is met, and keep the fastest that meets it."""


@dataclass(frozen=True)
class TrigonometricOptions(Objective):
    """A basis of trigonometric polynomials."""

    degree: Unstated[int] = None
    """Degree of the polynomials in every joint (default: chosen for each joint by validation)."""


@dataclass(frozen=True)
class KernelOptions:
    """The trigonometric energies in kernel form."""

    samples: Unstated[int] = None
    """Largest number of samples in the kernel (default: 600)."""
    precision: Unstated[Precision] = None
    """Floating-point type of the model (default: f64)."""


@dataclass(frozen=True)
class ArmOptions:
    """Prior knowledge of an arm whose joint frames are searched."""

    parents: Unstated[str] = None
    """Parent joint of every joint, counted from 1, with 0 for the ground, such as 0,1,2,1 (default: a chain)."""
    kinematic_prior: Unstated[Path] = None
    """JSON file with a rough description of the arm near which the search starts: axes and points of the joints at
    q = 0, or Denavit-Hartenberg rows."""


@dataclass(frozen=True)
class TreeOptions(ArmOptions, Objective, Limited):
    """A tree of unknown joint frames."""

    refine: Unstated[Literal["motions"]] = None
    """Fit physically consistent bodies and friction on the learned axes to motions (output error), and keep them if
    they predict validation motions longer."""


@dataclass(frozen=True)
class SelectionOptions(ArmOptions, Limited, Devices):
    """Model selection by validation."""

    robot: Unstated[Path] = None
    """URDF or MJCF file of the robot, whose tree is the first candidate."""
    lock: Unstated[str] = None
    """Comma-separated joints of --robot that do not move; "*finger*" matches all names that contain finger."""


class Fit(NamedTuple):
    """How a model is fitted."""

    method: Callable[[], Any]
    """() -> `training.dynamics.task.Method`, imported when it is used."""
    options: tuple[type, ...]
    """Dataclasses of the options that the fit reads."""


def fitted_by(module: str) -> Callable[[], Any]:
    """A function that imports the `METHOD` of a module in `methods`."""
    return lambda: importlib.import_module(f"dln_jax.training.dynamics.methods.{module}").METHOD


FITS = {
    "structured-delan": Fit(fitted_by("network"), (GrownOptions, NetworkOptions)),
    "black-box-delan": Fit(fitted_by("network"), (NetworkOptions,)),
    "feed-forward": Fit(fitted_by("network"), (NetworkOptions,)),
    "structured-hnn": Fit(fitted_by("network"), (NetworkOptions,)),
    "black-box-hnn": Fit(fitted_by("network"), (NetworkOptions,)),
    "trigonometric": Fit(fitted_by("least_squares"), (TrigonometricOptions,)),
    "trigonometric-kernel": Fit(fitted_by("kernel"), (KernelOptions,)),
    "learned-tree": Fit(fitted_by("learned_tree"), (TreeOptions,)),
    AUTO: Fit(fitted_by("selection"), (SelectionOptions,)),
}
"""Models of the commands; a new way of fitting is a module of `methods` and a line here."""


def options_of(stated: Mapping[str, Any]) -> tuple[type, ...]:
    """Options of the fit that a command line selects by its model and optimiser, or by whether it names data."""
    fit = FITS.get(model_of(stated))
    own = () if fit is None else fit.options
    if NetworkOptions not in own:
        return own
    optimiser = {"adam": (AdamOptions,), "gauss-newton": (GaussNewtonOptions,)}.get(str(stated.get("optimizer")), ())
    return (*optimiser, *own)


def model_of(stated: Mapping[str, Any]) -> str:
    """Model that a command line selects; for files, model selection unless an option of networks is stated."""
    if stated.get("model"):
        return stated["model"]
    return NETWORK if stated.get("data") is None or network_option(stated) else AUTO


def network_option(stated: Mapping[str, Any]) -> str | None:
    """Returns a stated option that only networks have, or `None`."""
    shared = {field.name for field in dataclasses.fields(SelectionOptions)}
    for kind in (NetworkOptions, AdamOptions, GaussNewtonOptions, GrownOptions):
        for field in dataclasses.fields(kind):
            if field.name not in shared and stated.get(field.name) not in (None, field.default):
                return f"--{field.name.replace('_', '-')}"
    return None


VARIANTS = Variants(
    options_of,
    {
        AdamOptions: "--optimizer adam",
        GaussNewtonOptions: "--optimizer gauss-newton",
        GrownOptions: "--model structured-delan",
        NetworkOptions: "networks, such as --model structured-delan",
        TrigonometricOptions: "--model trigonometric",
        SelectionOptions: "--model auto",
        TreeOptions: "--model learned-tree",
    },
)
