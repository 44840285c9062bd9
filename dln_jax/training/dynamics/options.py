"""Options of commands that train dynamics, and which of them a model uses."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from dln_jax.cli.arguments import Unstated, choice, refuse_given, require_positive_if_given
from dln_jax.cli.encoders import Filtered
from dln_jax.cli.options import Drawn, Limited, Resumable, Scaled, SingleCalls
from dln_jax.scenes.registry import SCENES
from dln_jax.types import InputError
from dln_jax.zoo.catalogue import CATALOGUE

NETWORK, AUTO = "structured-delan", "auto"
"""The default model of the embedded data, and the model selection that is the default for files."""
OF_NETWORKS = ("width", "depth", "activation")
OF_ADAM = ("batch", "learning_rate", "weight_decay", "patience")
OF_TRAININGS = ("steps", "target", "samples", "precision", "processes", "objective")


@dataclass(frozen=True)
class Options(Filtered, Limited, Resumable, Drawn, SingleCalls, Scaled):
    """What to train on, how, and where the results go."""

    model: str | None = None
    """What is learned."""
    data: Unstated[Path] = None
    """Trajectories as npz or CSV (default: the embedded characters, or random states of --scene)."""
    test: Unstated[str] = None
    """Labels of the test trajectories, comma separated (default: e,q,v of the embedded set, else every sixth; one or
    two recordings are cut into blocks of time)."""
    scene: Annotated[str | None, choice(SCENES, unstated=True)] = None
    """Textbook scene whose needs the data have; without --data, the scene to sample."""
    needs: Unstated[str] = None
    """What the plant needs, as JSON, for example '{"joints": ["revolute", "prismatic"], "friction": true}'
    (default: what the scene or the file states, else revolute joints with gravity and friction)."""
    optimizer: Literal["auto", "adam", "gauss-newton"] = "auto"
    """adam, gauss-newton (Levenberg-Marquardt, f64: orders of magnitude more accurate with small networks), or auto:
    gauss-newton while its equations are small and, for structured models of four joints or more, while the data show no
    more than a small network holds. The trigonometric models and the learned tree need none."""
    width: Unstated[int] = None
    """Hidden units per layer (default: 8 for structured models, 16 for others; 64 for adam; chosen by the data for
    structured models of four joints or more)."""
    depth: Unstated[int] = None
    """Hidden layers (default: 2)."""
    activation: Unstated[Literal["tanh", "softplus", "silu", "gelu", "sin", "cos"]] = None
    """Of the hidden layers (default: tanh)."""
    degree: Unstated[int] = None
    """trigonometric: degree of the polynomials in every joint (default: for each joint what validation asks for)."""
    steps: Unstated[int] = None
    """Iterations of gauss-newton (default: 150), or steps of adam (default: 20000); of structured models of four joints
    or more 40 and 6000."""
    samples: Unstated[int] = None
    """gauss-newton: training samples that are drawn and fitted (default: all; of an arm of four joints or more, so many
    that there are 14 equations a parameter). trigonometric-kernel: those that it is made of, at most (default: 600)."""
    batch: Unstated[int] = None
    """adam: samples per step (default: 512)."""
    learning_rate: Unstated[float] = None
    """adam: peak of the warm-up and cosine schedule (default: 0.005)."""
    weight_decay: Unstated[float] = None
    """adam: decoupled weight decay (default: 0.00001)."""
    patience: Unstated[int] = None
    """adam: steps without a better validation error after which training stops (default: 10000)."""
    precision: Unstated[Literal["f32", "f64"]] = None
    """Floating-point type of the model and its training (default: f64; f32 for adam)."""
    objective: Unstated[Literal["inverse", "forward", "both"]] = None
    """Errors that are made small: inverse (torques), forward (accelerations), or both, each over its variance in the
    training samples (default: inverse; of Hamiltonians with momenta, Hamilton's equations; of feed-forward, both)."""
    target: Unstated[float] = None
    """Validation error, in (N m)² or N²: grow the structured network (width 4, 8, 16, 32; one or two layers; M and V
    from one network or two) until it is met, and keep the fastest model that meets it."""
    seed: int = 0
    """Of the initial parameters, the shuffling and the validation split; 0 to 4294967295."""
    seeds: int = 1
    """Train so many seeds, --seed and those after it, in one program; kept is the best in cross-validation."""
    folds: int = 3
    """With --seeds: parts of the training and validation motions that each seed is also trained without, one after the
    other; the seed that predicts them best is kept (1: by the validation motions, without these trainings)."""
    uncertainty: bool = True
    """Store how uncertain the torque is at any state and whether a state is outside the data, and test both."""


@dataclass(frozen=True)
class ArmOptions(Options):
    """What to train on, how, and where the results go, where it may be an arm."""

    robot: Unstated[Path] = None
    """auto: URDF or MJCF file, whose kinematics is the first candidate of model selection."""
    lock: Unstated[str] = None
    """Joints of --robot that do not move, comma separated; "*finger*" names all with finger in their name."""
    parents: Unstated[str] = None
    """auto and learned-tree: the joint that each one hangs on, counted from 1, with 0 for the ground, for example
    0,1,2,1 (default: one after the other)."""
    kinematic_prior: Unstated[Path] = None
    """auto and learned-tree: JSON file with a rough description of the arm, which the search starts near: axes and
    points of the joints at q = 0, or Denavit-Hartenberg rows."""
    velocity_scale: Unstated[float] = None
    """rad/s or m/s below which dry friction of joints is smooth (default: what the needs state, else 0.01; fitted for
    --robot)."""


def with_model(given: Options) -> tuple[Options, str]:
    """Completes the options with a model, and explains the choice if the user should know about it.

    For files the default is model selection. Options used by networks only select a network, as do the embedded data.
    """
    if given.model is not None:
        return given, ""
    if given.data is None:
        return dataclasses.replace(given, model=NETWORK), ""
    asked = [name for name in (*OF_NETWORKS, *OF_ADAM, *OF_TRAININGS) if getattr(given, name) is not None]
    asked += [name for name in ("optimizer", "seeds") if getattr(given, name) != getattr(type(given), name)]
    if not asked:
        return dataclasses.replace(given, model=AUTO), ""
    option = f"--{asked[0].replace('_', '-')}"
    kind = "one model" if asked[0] == "objective" else "networks"
    said = f"{option} is for {kind}, so the model is {NETWORK}; without it several models are tried (--model auto)"
    return dataclasses.replace(given, model=NETWORK), said


def check_direct_options(given: Options, others: tuple[str, ...], model: str, why: str) -> None:
    """Refuses the options of networks and optimisers, and `others`, for a model fitted without them."""
    if given.seeds > 1:
        raise InputError(f"--seeds is {given.seeds}, but {model} {why} and has no seeds; leave it out")
    of_networks = (*OF_NETWORKS, *OF_ADAM, "steps", "target", "processes")
    refuse_given(given, (*of_networks, *others), f"for networks; {model} {why}")
    if given.optimizer != "auto":
        raise InputError(f"{model} {why}; leave --optimizer out")


def check_arm_options(given: ArmOptions, kind: str) -> None:
    """Refuses options for arms if another kind of model was selected."""
    require_positive_if_given(given, ["velocity_scale"])
    if given.model == AUTO:
        return
    refuse_given(given, ["robot", "lock"], "for --model auto (python -m scripts.identify fits a robot of a file)")
    if not CATALOGUE[kind].properties.searched:
        refuse_given(given, ["parents", "kinematic_prior"], "for --model auto and learned-tree")
