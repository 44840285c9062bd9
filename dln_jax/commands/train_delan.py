"""Train a model of dynamics on a log with torques.

Models: structured-delan (a deep Lagrangian network, M = L Lᵀ), black-box-delan (a network is the Lagrangian),
trigonometric (linear in its parameters), trigonometric-kernel (the same as a Gaussian process), learned-tree (rigid
bodies with unknown joint frames), feed-forward (no physics), auto (model selection). --model NAME --help shows the
options of a model. Without --data, a two-link arm writes 20 letters. The table reports errors, rollouts and speed. Load
the run with dln_jax.load.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import tyro

from dln_jax.learning.fits.settings import Automatic, Kernel, LearnedTree, Network, Trigonometric
from dln_jax.options import Devices, Drawn, Filtered, Limited, Logged, Resumable, Scaled, SceneName, Unstated
from dln_jax.runs.arguments import Variants

NETWORK, AUTO = "structured-delan", "auto"
ModelName = Annotated[
    Literal[
        "structured-delan",
        "black-box-delan",
        "trigonometric",
        "trigonometric-kernel",
        "learned-tree",
        "feed-forward",
        "auto",
    ],
    tyro.conf.arg(
        help="Model to learn (default: auto with --data, else structured-delan).",
        help_behavior_hint="",
    ),
]


@dataclass(frozen=True)
class Plant(Drawn, Resumable, Filtered):
    """Data and what they show, and where the results go."""

    data: Unstated[Path] = None
    """Trajectories as npz, CSV or ROS bag (default: letters)."""
    test: Unstated[str] = None
    """Test trajectories: comma-separated labels; last:30% of each; or blocks, for ten blocks of time in each (default:
    e,q,v, else every sixth, else blocks)."""
    scene: Unstated[SceneName] = None
    """Textbook system, such as chain-3, which states the needs and, without --data, gives the data."""
    needs: Unstated[str] = None
    """Joints and terms, such as 'rp friction' for a revolute and a prismatic joint, or as JSON (default: the scene's or
    file's, else revolute, gravity, friction)."""
    seed: int = 0
    """Seed for parameters, shuffling and validation."""
    uncertainty: bool = True
    """Estimate the uncertainty of the torques, which also flags states out of distribution."""


@dataclass(frozen=True)
class NetworkOptions(Network, Limited, Scaled, Plant):
    """A network, what to train it on, and how."""

    model: ModelName = NETWORK


@dataclass(frozen=True)
class TrigonometricOptions(Trigonometric, Plant):
    """A basis of trigonometric polynomials, and what to fit it to."""

    model: ModelName = "trigonometric"


@dataclass(frozen=True)
class KernelOptions(Kernel, Plant):
    """The trigonometric energies in kernel form, and what to fit them to."""

    model: ModelName = "trigonometric-kernel"


@dataclass(frozen=True)
class TreeOptions(LearnedTree, Limited, Plant):
    """A tree of unknown joint frames, and what to fit it to."""

    model: ModelName = "learned-tree"


@dataclass(frozen=True)
class AutomaticOptions(Automatic, Limited, Devices, Plant):
    """Model selection by validation, and the data for it."""

    model: ModelName = AUTO
    robot: Unstated[Path] = None
    """URDF or MJCF file of the robot, whose tree is the first candidate."""
    lock: Unstated[str] = None
    """Comma-separated joints of --robot that do not move; "*finger*" matches all names that contain finger."""


CLASSES = {
    "trigonometric": TrigonometricOptions,
    "trigonometric-kernel": KernelOptions,
    "learned-tree": TreeOptions,
    AUTO: AutomaticOptions,
}
"""Options by model; those of all others are networks'."""


def class_of(stated: Mapping[str, Any]) -> type:
    """Options of the model that a command line selects.

    Without --model, files get model selection unless an option of networks is stated.
    """
    model = stated.get("model")
    if model is None and stated.get("data") is not None:
        shared = {field.name for field in dataclasses.fields(AutomaticOptions)}
        own = {field.name: field.default for field in dataclasses.fields(NetworkOptions) if field.name not in shared}
        model = NETWORK if any(stated.get(name, default) != default for name, default in own.items()) else AUTO
    return CLASSES.get(str(model), NetworkOptions)


@dataclass(frozen=True)
class Arguments(Plant):
    """What to train on, how, and where the results go; `VARIANTS` says which options a model has."""

    VARIANTS: ClassVar = Variants(
        class_of,
        {
            NetworkOptions: "networks, such as --model structured-delan",
            TrigonometricOptions: "--model trigonometric",
            KernelOptions: "--model trigonometric-kernel",
            AutomaticOptions: "--model auto",
            TreeOptions: "--model learned-tree",
        },
    )
    model: Unstated[ModelName] = None


Options = NetworkOptions | TrigonometricOptions | KernelOptions | TreeOptions | AutomaticOptions


def main(options: Options) -> None:
    """Trains and evaluates the model, and writes the run folder."""
    train(options, "train_delan")


def train(options: Options, command: str) -> None:
    """Trains, evaluates and writes a run folder, by default runs/`command`-1, -2, ...

    Raises:
        InputError: a mistake in the options or data; nothing is then left behind.
        FitRefused: the model must not be used, and no limit of the user ended its training; the run folder is complete.
    """
    from dln_jax.data.log import split_log
    from dln_jax.learning.engine.checkpoint import Context
    from dln_jax.learning.fit import with_uncertainty
    from dln_jax.process import deadline
    from dln_jax.runs.devices import mesh_of
    from dln_jax.runs.evaluation import evaluate
    from dln_jax.runs.folder import command_folder
    from dln_jax.runs.progress import progress
    from dln_jax.runs.report import finish
    from dln_jax.types import require_positive

    seconds = options.seconds if isinstance(options, Limited) else None
    if seconds is not None:
        require_positive(seconds=seconds)
    until, mesh = deadline(seconds), mesh_of(options) if isinstance(options, Devices) else None
    log, test = read(options)
    parts = split_log(log, test, seed=options.seed)
    with command_folder(options, command) as folder:
        needs, counts = log.needs, (f"{len(part.t)} {role}" for role, part in parts.sets._asdict().items())
        terms = [name for name in ("gravity", "friction") if getattr(needs, name)] or ["no potential, no friction"]
        print(f"{log.name}: {', '.join(counts)} samples")
        print(f"{'-'.join(needs.joints)} with {' and '.join(terms)} ({log.needs_origin})")
        if needs.joint_friction:
            print(f"friction of joints: {', '.join(needs.joint_friction)}")
        for line in (*log.remarks, *parts.remarks):
            print(line)
        fit = options.fit(log, parts, Context(options.seed, until, print, progress, folder, options.resume, mesh))
        fit.save(folder)
        if options.uncertainty:
            fit = with_uncertainty(fit, parts, log.torque, print)
            fit.save(folder)
        report = evaluate(fit, parts, log, mesh=mesh)
        limited = seconds is not None or (isinstance(options, Network) and options.steps is not None)
        finish(folder, options, report._replace(ended_by_user=fit.optimiser is not None and limited))


def read(options: Options) -> Any:
    """The log that the options name, and its test."""
    from dln_jax.data.log import log_of, read_log
    from dln_jax.data.robots import read_robot
    from dln_jax.runs.arguments import cutoff, facts, names_listed, needs_of, refuse_given
    from dln_jax.scenes.datasets.generators import CHARACTERS_TEST, default_data
    from dln_jax.scenes.pendulums import two_link_arm
    from dln_jax.scenes.registry import scene_named

    scene = scene_named(options.scene) if options.scene else None
    stated, test = needs_of(options.needs), options.test
    robot, more = None, ""
    if isinstance(options, AutomaticOptions):
        if options.robot is None:
            refuse_given(options, ["lock"], "for joints of --robot")
        else:
            robot = read_robot(options.robot, lock=names_listed(options.lock))
            more = f" --robot {options.robot}" + (f" --lock '{options.lock}'" if options.lock else "")
    if options.data is None and scene is None:
        scene = two_link_arm()
    known: dict[str, Any] = {"robot": robot, "needs": stated}
    if stated is None and scene is not None:
        known |= {"needs": scene.needs, "needs_origin": f"scene {scene.name}"}
    if options.data is not None:
        log = read_log(options.data, more=more, **facts(options), **known)
    else:
        assert scene is not None
        of_file = [field.name for field in dataclasses.fields(Logged)]
        refuse_given(options, of_file, "for a file: add --data")
        log = log_of(default_data(scene), f"default data of {scene.name}", cutoff=cutoff(options.cutoff), **known)
        if test is None and scene.name == "two-link-arm":
            test = ",".join(CHARACTERS_TEST)
    return log if scene is None else log._replace(plant=scene.energies, tip=scene.tip), test
