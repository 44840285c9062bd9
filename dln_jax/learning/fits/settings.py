"""Ways of fitting a model of dynamics to a log: settings, each with its fit.

    fit = Network(width=16).fit(log, split_log(log), Context(seconds=60))

The commands take them as options. Importing this module does not import JAX.
"""

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from dln_jax.options import InPython, Unstated

if TYPE_CHECKING:
    import dln_jax.data.log
    import dln_jax.learning.engine.checkpoint
    import dln_jax.learning.fit

ActivationName = Literal["tanh", "softplus", "silu", "gelu", "sin", "cos"]
Precision = Literal["f32", "f64"]
OF_ADAM = ("batch", "learning_rate", "weight_decay", "patience", "rule")
"""Settings of a network for Adam only; `samples` is for Gauss-Newton only."""


@dataclass(frozen=True)
class Way:
    """Settings of a way of fitting."""

    FITTED_BY: ClassVar[str]
    """Module and function of `learning.fits`, imported on the first call."""

    def fit(
        self,
        log: "dln_jax.data.log.Log",
        parts: "dln_jax.data.log.Parts",
        context: "dln_jax.learning.engine.checkpoint.Context",
    ) -> "dln_jax.learning.fit.Fit":
        """Fits a model to the training motions of a log."""
        module, function = self.FITTED_BY.split(".")
        return getattr(import_module(f"dln_jax.learning.fits.{module}"), function)(self, log, parts, context)


@dataclass(frozen=True)
class Goal(Way):
    """Precision and objective of a fit."""

    precision: Unstated[Precision] = None
    """Floating-point type (default: f64; f32 for adam)."""
    objective: Unstated[Literal["inverse", "forward", "both"]] = None
    """Errors of torques, accelerations or both (default: inverse; feed-forward: both)."""


@dataclass(frozen=True)
class Network(Goal):
    """A network and its training."""

    model: str = "structured-delan"
    optimizer: Literal["auto", "adam", "gauss-newton"] = "auto"
    """gauss-newton is more accurate for small networks."""
    width: Unstated[int] = None
    """Hidden units per layer (default: structured 8, others 16, adam 64; chosen from the data for 4 joints or more)."""
    depth: Unstated[int] = None
    """Hidden layers (default: 2)."""
    activation: Unstated[ActivationName] = None
    """Activation of the hidden layers (default: tanh)."""
    steps: Unstated[int] = None
    """Iterations (default: structured 150, others 400, adam 20000; for 4 joints or more 40 and 6000)."""
    seeds: int = 1
    """Seeds in one program; cross-validation keeps the best."""
    batch: Unstated[int] = None
    """adam: samples per step (default: 512)."""
    learning_rate: Unstated[float] = None
    """adam: peak of the warm-up and cosine schedule (default: 0.005)."""
    samples: Unstated[int] = None
    """gauss-newton: training samples to draw and fit (default: all; for 4 joints or more, 14 equations per
    parameter)."""
    target: Unstated[float] = None
    """structured-delan: validation error, (N m)² or N²: grow the network until it is met, and keep the fastest that
    meets it."""
    weight_decay: InPython[float | None] = None
    """adam: decoupled weight decay (default: 0.00001)."""
    patience: InPython[int | None] = None
    """adam: stop after this many steps without improvement of the validation error (default: 10000)."""
    rule: InPython[Any] = None
    """adam: an optax optimiser in its place."""
    folds: InPython[int] = 3
    """Folds of the cross-validation over seeds (1: use the validation motions alone)."""

    FITTED_BY = "network.fit"


@dataclass(frozen=True)
class Trigonometric(Goal):
    """A basis of trigonometric polynomials."""

    model: str = "trigonometric"
    degree: Unstated[int] = None
    """Degree of the polynomials in every joint (default: chosen for each joint by validation)."""

    FITTED_BY = "direct.fit_basis"


@dataclass(frozen=True)
class Kernel(Way):
    """The trigonometric energies in kernel form."""

    model: str = "trigonometric-kernel"
    samples: Unstated[int] = None
    """Largest number of samples in the kernel (default: 600)."""
    precision: Unstated[Precision] = None
    """Floating-point type of the model (default: f64)."""

    FITTED_BY = "direct.fit_energies"


@dataclass(frozen=True)
class Arm(Way):
    """Prior knowledge of an arm for the search of its joint frames."""

    parents: Unstated[str] = None
    """Parent joint of every joint, counted from 1, with 0 for the ground, such as 0,1,2,1 (default: a chain)."""
    kinematic_prior: Unstated[Path] = None
    """JSON file with a rough description of the arm near which the search starts: axes and points of the joints at
    q = 0, or Denavit-Hartenberg rows."""


@dataclass(frozen=True)
class LearnedTree(Arm, Goal):
    """A tree of unknown joint frames."""

    model: str = "learned-tree"

    FITTED_BY = "direct.fit_arm"


@dataclass(frozen=True)
class Automatic(Arm):
    """Model selection by validation."""

    model: str = "auto"

    FITTED_BY = "automatic.fit"


WAYS: dict[str, type[Way]] = {
    **dict.fromkeys(
        ("structured-delan", "black-box-delan", "feed-forward", "structured-hnn", "black-box-hnn"), Network
    ),
    "trigonometric": Trigonometric,
    "trigonometric-kernel": Kernel,
    "learned-tree": LearnedTree,
    "auto": Automatic,
}
"""How each model is fitted; a new way of fitting is a line here."""
