"""Train a value function: the cost to go of a plant as a network, whose slope is the best control in closed form.

Trains by fitted value iteration, or on the residual of the Hamilton-Jacobi-Bellman equation, prints how long that took
and what the law costs in the published evaluation (100 starts), and writes a run folder: value.safetensors and
value.json (load them with dln_jax.training.values.load_value), metrics.json and config.json.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from dln_jax.cli.arguments import Unstated, Variants, choice
from dln_jax.cli.options import Folder, Scaled


@dataclass(frozen=True)
class TrainingOptions:
    """Plant, method and networks."""

    plant: Annotated[str, choice(("pendulum", "cart-pole", "rotary-pendulum"))] = "pendulum"
    """The plant and its costs."""
    method: Literal["fitted", "residual"] = "fitted"
    """fitted: value iteration along trajectories of the model; residual: the equation itself, by Gauss-Newton."""
    goal: Unstated[str] = None
    """Posture to hold, rad or m, separated by commas (default: upright)."""
    width: Unstated[int] = None
    """Hidden units per layer (default: 96; residual: 24)."""
    depth: Unstated[int] = None
    """Hidden layers (default: 3; residual: 2)."""
    members: Unstated[int] = None
    """Number of networks, of which V is the mean (default: 1)."""
    iterations: Unstated[int] = None
    """Iterations of value iteration (default: 48 or 80 by the plant), or of Gauss-Newton per discount (15)."""
    seed: int = 0
    """Seed of parameters and states."""
    seeds: int = 1
    """Number of trainings; the best in validation is kept."""


def options_of(stated: Mapping[str, Any]) -> tuple[type, ...]:
    """Options of the training, which a stored value function does not need."""
    return () if stated.get("stored") else (TrainingOptions,)


@dataclass(frozen=True)
class Arguments(Scaled, Folder):
    """Plant, method, and where the results go."""

    VARIANTS: ClassVar = Variants(options_of, {TrainingOptions: "a training, without --stored"})
    starts: int = 100
    """Starts of the evaluation, hanging and anywhere each."""
    stored: Unstated[Path] = None
    """Folder of a run whose value function is evaluated on its plant; nothing is trained (default: train one)."""


def main(options: Arguments) -> None:
    """Trains and evaluates a value function, or evaluates a stored one, and writes the run folder."""
    from dln_jax.training.pipeline import train
    from dln_jax.training.value_training import VALUES

    train(VALUES, options, "train_value")
