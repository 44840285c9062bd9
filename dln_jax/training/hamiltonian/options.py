"""Options of Hamiltonian trainings in a phase space. Importing them does not import JAX."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from dln_jax.runs.arguments import Unstated, Variants, choice
from dln_jax.runs.options import Checked, Drawn, Limited, Resumable, Scaled

REAL, MEASURED = "real-pendulum", "measured"
GENERATED = (
    *("spring", "pendulum", "damped-spring", "damped-pendulum", "henon-heiles", "double-pendulum", "two-body"),
    "three-body",
)
"""Tasks whose data are generated: the names of `scenes.datasets.hamiltonian_tasks.PROTOCOLS`."""
POLYNOMIAL = "polynomial-hamiltonian"
DIRECT = (POLYNOMIAL, "trigonometric", "planar-chain")
"""Models without a network."""


@dataclass(frozen=True)
class Motion:
    """The system that moves, and the model to learn."""

    task: Annotated[str, choice((*GENERATED, REAL, MEASURED))] = "spring"
    """System that moves; measured stands for any --data."""
    model: Literal[
        "auto",
        "separable-hnn",
        "structured-hnn",
        "black-box-hnn",
        "pairwise-hnn",
        "polynomial-hamiltonian",
        "phase-network",
        "helmholtz-hnn",
        "structured-delan",
        "trigonometric",
        "planar-chain",
    ] = "auto"
    """Model to learn; auto: the one that suits the task, for measured the smallest whose validation error no other
    beats. The last three are for measured."""
    optimizer: Literal["auto", "adam", "gauss-newton"] = "auto"
    """auto: gauss-newton."""
    steps: Unstated[int] = None
    """Steps of each stage (default: the task's)."""
    seed: int = 0
    """Seed of parameters, shuffling and validation split."""


@dataclass(frozen=True)
class Options(Drawn, Scaled, Limited, Resumable, Motion):
    """What to train on, how, and where the results go."""


@dataclass(frozen=True)
class GeneratedOptions:
    """Generated motions."""

    trajectories: Unstated[int] = None
    """Generated trajectories (default: the task's)."""


@dataclass(frozen=True)
class RecordedOptions(Checked):
    """Recorded motions."""

    data: Unstated[Path] = None
    """Trajectories as npz, CSV or ROS bag."""


@dataclass(frozen=True)
class MeasuredOptions(RecordedOptions):
    """Recorded motions of any plant."""

    needs: Unstated[str] = None
    """Joints and terms of the plant, such as '{"joints": ["revolute"], "friction": true}' (default: those of the file,
    else revolute joints, a potential and friction)."""
    test: Unstated[str] = None
    """Test trajectories: labels, an npz file, last:30% for the end of every trajectory, or blocks, for ten blocks of
    time in each (default: every sixth, or the last fifth)."""
    noise: Unstated[str] = None
    """Standard deviations of q, or of q and p if the file has p: one number or one each (default: estimated)."""


@dataclass(frozen=True)
class BodiesOptions:
    """Bodies that attract each other in pairs."""

    order: Unstated[Literal["bodies", "axes"]] = None
    """Order of the coordinates: x1, y1, x2, y2 or x1, x2, y1, y2 (default: the order that balances the forces)."""


@dataclass(frozen=True)
class FieldOptions:
    """Helmholtz decomposition."""

    field: Unstated[Literal["solenoidal", "conservative", "both"]] = None
    """The part that conserves an energy, the gradient, or both (default: both)."""


@dataclass(frozen=True)
class ChainOptions:
    """Planar chain."""

    coordinates: Unstated[Literal["relative", "absolute"]] = None
    """relative: joint angles; absolute: angles from the vertical (default: relative)."""


@dataclass(frozen=True)
class DegreeOptions:
    """Polynomials."""

    degree: Unstated[int] = None
    """Degree (default: polynomial by validation, trigonometric 1)."""


@dataclass(frozen=True)
class NetworkOptions:
    """Networks."""

    width: Unstated[int] = None
    """Hidden units per layer (default: the task's)."""
    depth: Unstated[int] = None
    """Hidden layers (default: the task's)."""
    activation: Unstated[Literal["tanh", "softplus", "silu", "gelu", "sin", "cos"]] = None
    """Activation of the hidden layers (default: tanh)."""


@dataclass(frozen=True)
class AdamOptions:
    """Adam."""

    learning_rate: Unstated[float] = None
    """Peak of the warm-up and cosine schedule (default: 0.005)."""


def options_of(stated: Mapping[str, Any]) -> tuple[type, ...]:
    """Options of the task, of the model and of the optimiser."""
    task, model = stated["task"], stated["model"]
    own = {
        "helmholtz-hnn": (FieldOptions,),
        "planar-chain": (ChainOptions,),
        POLYNOMIAL: (DegreeOptions,),
        "trigonometric": (DegreeOptions,),
    }.get(model, ())
    if task == MEASURED and model in ("auto", "pairwise-hnn"):
        own = (BodiesOptions,)
    return (
        *((AdamOptions,) if stated["optimizer"] == "adam" else ()),
        *own,
        *(() if model in DIRECT else (NetworkOptions,)),
        GeneratedOptions if task in GENERATED else MeasuredOptions if task == MEASURED else RecordedOptions,
    )


VARIANTS = Variants(
    options_of,
    {
        AdamOptions: "--optimizer adam",
        FieldOptions: "--model helmholtz-hnn",
        ChainOptions: "--model planar-chain",
        DegreeOptions: "--model polynomial-hamiltonian and trigonometric",
        BodiesOptions: "--task measured with --model pairwise-hnn",
        NetworkOptions: "networks",
        GeneratedOptions: "tasks that generate their data",
        MeasuredOptions: "--task measured",
    },
)
