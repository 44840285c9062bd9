"""Train a value function and its optimal control law.

The value function is the cost to go of a plant as a network, whose gradient gives the optimal control. It is trained by
fitted value iteration, or on the residual of the Hamilton-Jacobi-Bellman equation. The table reports the training time
and the cost of the law from 100 starts near hanging and 100 anywhere. The run folder gets value.safetensors and
value.json (dln_jax.load(folder).value), metrics.json, config.json, and figures of V and of the closed loop. --out
FOLDER --resume continues an interrupted run.

--plant takes the name of a desktop plant or an MJCF or URDF file, and --run the folder of a learned or identified
model. Costs, box and times follow from the plant's natural scales and limits, and are printed. A law that fails to
bring its starts upright is refused with exit status 1, unless your own --iterations ended the training.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from dln_jax.options import Drawn, Resumable, Scaled, Unstated, choice
from dln_jax.runs.arguments import Variants


@dataclass(frozen=True)
class TrainingOptions:
    """Plant, method and networks."""

    plant: Annotated[str, choice(("pendulum", "cart-pole", "rotary-pendulum", "FILE"))] = "pendulum"
    """A desktop plant (Lutter et al. 2021), or FILE, the path of an MJCF or URDF file."""
    run: Unstated[Path] = None
    """Folder of a learned or identified model that is the plant (default: --plant)."""
    actuated: Unstated[str] = None
    """Joints with a motor, comma-separated names or numbers from 0 (default: the file's or the model's)."""
    control: Unstated[str] = None
    """Largest force of the motors, N m or N, one for all or one each (default: as stated in the file)."""
    positions: Unstated[str] = None
    """LOW:HIGH or free for each joint, rad or m, comma separated (default: the file's; of a model, free)."""
    weights: Unstated[str] = None
    """Weights of the squared deviations of coordinates and rates (default: by the plant's scales)."""
    effort: Unstated[float] = None
    """Cost of half the motors' limits relative to the cost of hanging (default: 0.25)."""
    box: Unstated[str] = None
    """Half widths of the box of coordinates and rates (default: by the plant's scales)."""
    robust: float = 0.0
    """Train against the worst errors of masses and motors up to this fraction."""
    method: Literal["fitted", "residual"] = "fitted"
    """fitted: value iteration along trajectories of the model; residual: Gauss-Newton on the equation's residual."""
    goal: Unstated[str] = None
    """Posture to hold, rad or m, separated by commas (default: upright)."""
    width: Unstated[int] = None
    """Hidden units per layer (default: 96; residual: 24)."""
    depth: Unstated[int] = None
    """Hidden layers (default: 3; residual: 2)."""
    members: Unstated[int] = None
    """Number of networks, whose mean is V (default: 1)."""
    iterations: Unstated[int] = None
    """Iterations of value iteration (default: 80), or of Gauss-Newton per discount (15)."""
    seed: int = 0
    """Seed for parameters and states."""
    seeds: int = 1
    """Number of trainings; the best by validation is kept."""


def class_of(stated: Mapping[str, Any]) -> type:
    """All options, or those that a stored value function needs."""
    return Arguments if stated.get("stored") else Training


@dataclass(frozen=True)
class Arguments(Scaled, Drawn, Resumable):
    """Plant, method, and where the results go."""

    VARIANTS: ClassVar = Variants(class_of, {TrainingOptions: "a training, without --stored"})
    starts: int = 100
    """Number of starts in the evaluation, near hanging and again anywhere."""
    stored: Unstated[Path] = None
    """Folder of a run whose value function is evaluated, without training (default: train one)."""


@dataclass(frozen=True)
class Training(TrainingOptions, Arguments):
    """A training, and where the results go."""


def main(options: Arguments) -> None:
    """Trains and evaluates a value function, or evaluates a stored one, and writes the run folder."""
    from dln_jax.commands.values import run

    if options.stored is None:
        run.train(options)
    else:
        run.evaluate_stored(options)
