"""From options to a task of dynamics: the data, what they need, the model, and how it is trained."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from dln_jax.command_line.arguments import Unstated, choice, refuse_given, resolved
from dln_jax.command_line.encoders import Filtered, checked, preparation, smoothed
from dln_jax.command_line.optimisers import name_of, optimiser_named
from dln_jax.command_line.options import Drawn, Limited, Resumable, SingleCalls
from dln_jax.command_line.running import needs_from_option
from dln_jax.data import schema
from dln_jax.data.encoders import labels_of_parts
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import Split, split
from dln_jax.datasets.default_data import CHARACTERS_TEST, default_data
from dln_jax.learning import dynamics
from dln_jax.learning.engine.optimisers import Optimiser
from dln_jax.learning.engine.problem import Problem, require_finite_start
from dln_jax.learning.objectives import Objective, objective_of
from dln_jax.scenes.registry import SCENES, scene_named
from dln_jax.scenes.scene import Scene
from dln_jax.scenes.two_link_arm import two_link_arm
from dln_jax.types import InputError, Needs, require_positive, require_seed
from dln_jax.zoo.catalogue import CATALOGUE
from dln_jax.zoo.descriptions import build, describe_for

OF_NETWORKS = ("width", "depth", "activation")
SAMPLES = 600
"""Of a kernel, by default."""
OF_ADAM = ("batch", "learning_rate", "weight_decay", "patience")


@dataclass(frozen=True)
class Options(Filtered, Limited, Resumable, Drawn, SingleCalls):
    """What to train on, how, and where the results go."""

    model: str = "structured-delan"
    """What is learned."""
    data: Unstated[Path] = None
    """Trajectories in the npz schema (default: the embedded characters, or random states of --scene)."""
    test: Unstated[str] = None
    """Labels of the test trajectories, comma separated (default: e,q,v of the embedded set, else every sixth)."""
    scene: Annotated[str | None, choice(SCENES, unstated=True)] = None
    """Textbook scene whose needs the data have; without --data, the scene to sample."""
    needs: Unstated[str] = None
    """What the plant needs, as JSON, for example '{"joints": ["revolute", "prismatic"], "friction": true}'
    (default: what the scene or the file states, else revolute joints with gravity)."""
    optimizer: Literal["auto", "adam", "gauss-newton"] = "auto"
    """adam, gauss-newton (Levenberg-Marquardt, f64: orders of magnitude more accurate with small networks), or auto:
    gauss-newton while its equations are small. The trigonometric models and the learned tree need none."""
    width: Unstated[int] = None
    """Hidden units per layer (default: 8 for structured models, 16 for others; 64 for adam)."""
    depth: Unstated[int] = None
    """Hidden layers (default: 2)."""
    activation: Unstated[Literal["tanh", "softplus", "silu", "gelu", "sin", "cos"]] = None
    """Of the hidden layers (default: tanh)."""
    degree: Unstated[int] = None
    """trigonometric: degree of the polynomials in every joint (default: for each joint what validation asks for)."""
    samples: Unstated[int] = None
    """trigonometric-kernel: samples of the training data that it is made of, at most (default: 600)."""
    steps: Unstated[int] = None
    """Iterations of gauss-newton (default: 150), or steps of adam (default: 20000)."""
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
    target: Unstated[float] = None
    """Validation error, in (N m)² or N²: grow the structured network (width 4, 8, 16, 32; one or two layers; M and V
    from one network or two) until it is met, and keep the fastest model that meets it. --seconds counts for each."""
    seed: int = 0
    """Of the initial parameters, the shuffling and the validation split; 0 to 4294967295."""
    seeds: int = 1
    """Train so many seeds, --seed and those after it, in one program; the model kept is the best in validation."""
    uncertainty: bool = True
    """Store how uncertain the torque is at any state and whether a state is outside the data, and test both."""


class Solver(NamedTuple):
    """How a model is trained."""

    optimiser: Optimiser
    reason: str
    """Why it is that one; empty where the user chose."""
    problem: Problem


class Task(NamedTuple):
    """What the arguments come to: the data, what they need, and the model to train."""

    name: str
    kind: str
    sets: Split
    scene: Scene | None
    needs: Needs
    needs_origin: str
    description: dict[str, Any]
    """Of the model, for `dln_jax.zoo.build`."""
    objective: Objective
    solver: Solver | None
    """`None` for models that have a fit of their own."""
    seeds: int | tuple[int, ...]
    """One, or several in one program."""
    seconds: float
    """Of training, after which to stop."""
    said: tuple[str, ...] = ()
    """Where rates come from, and what is wrong with the data."""
    cutoff: float | None = None
    """Hz, of the filter that was applied to q; `None` without."""

    @property
    def precision(self) -> str:
        """f32 or f64, of the model and its training."""
        return self.description["precision"]


def prepare(given: Options) -> Task:
    """Reads and checks everything that the arguments name, before anything is written."""
    kind = given.model
    scene = scene_named(given.scene) if given.scene else None
    labels = tuple(given.test.split(",")) if given.test else None
    if given.data is not None:
        data, name = schema.load(given.data), str(given.data)
    else:
        scene = scene or two_link_arm()
        data, name = default_data(scene), f"default data of {scene.name}"
        if labels is None and scene.name == "two-link-arm":
            labels = CHARACTERS_TEST
    needs, origin = stated_needs(given, scene, data)
    if needs.degrees_of_freedom != data.degrees_of_freedom:
        raise InputError(
            f"{origin} has {needs.degrees_of_freedom} joints, but {name} has {data.degrees_of_freedom}; make them agree"
        )
    data = data._replace(needs=needs)
    found = checked(data) if given.data is not None else []
    filtered = smoothed(given, data)
    said = [*preparation(data, filtered), *found]
    if filtered is not None:
        data = filtered.data
        labels = None if labels is None else labels_of_parts(data, labels)
    sets = split(data, test=labels, seed=given.seed)
    objective = objective_of(kind, sets.train)
    description, optimiser, reason = model_and_optimiser(given, kind, sets, needs, objective)
    seeds = given.seed if given.seeds == 1 else tuple(range(given.seed, given.seed + given.seeds))
    limit = resolved(given, {"seconds": math.inf})
    require_positive(**limit)
    model, solver = build(description), None
    if optimiser is not None:
        problem = dynamics.problem(model, sets, objective, seeds=seeds)
        require_finite_start(problem, dynamics.samples(model, sets, objective))
        solver = Solver(optimiser, reason, problem)
    cutoff = None if filtered is None else filtered.cutoff
    return Task(
        name, kind, sets, scene, needs, origin, description, objective, solver, seeds, **limit,
        said=tuple(said), cutoff=cutoff,
    )  # fmt: skip


def check_options(given: Options, kind: str) -> None:
    """Refuses options that the model does not read."""
    require_positive(seeds=given.seeds)
    require_seed(given.seed, given.seeds)
    properties = CATALOGUE[kind].properties
    if properties.kernel:
        others = ("degree", "seconds")
        check_direct_options(given, others, "the trigonometric kernel", "is one linear problem")
        require_positive(**resolved(given, {"samples": SAMPLES}))
        return
    refuse_given(given, ["samples"], "for the trigonometric kernel")
    if properties.searched:
        check_direct_options(given, ("degree",), "the learned tree", "has a search of its own")
        return
    if properties.linear:
        check_direct_options(given, ("seconds",), "the trigonometric model", "is one least-squares problem")
        return
    refuse_given(given, ["degree"], "for the trigonometric model")
    if given.target is not None:
        if kind != "structured-delan" or given.optimizer == "adam" or given.seeds > 1:
            raise InputError("--target grows one structured network by gauss-newton; leave the other options out")
        refuse_given(given, ["width", "depth"], "what --target grows")
        require_positive(target=given.target)


def check_direct_options(given: Options, others: tuple[str, ...], model: str, why: str) -> None:
    """Refuses the options of networks and optimisers, and others, for a model that is fitted without them."""
    if given.seeds > 1:
        raise InputError(f"--seeds is {given.seeds}, but {model} {why} and has no seeds; leave it out")
    refuse_given(given, (*OF_NETWORKS, *OF_ADAM, "steps", "target", *others), f"for networks; {model} {why}")
    if given.optimizer != "auto":
        raise InputError(f"{model} {why}; leave --optimizer out")


def stated_needs(given: Options, scene: Scene | None, data: Trajectories) -> tuple[Needs, str]:
    """What the plant needs, and who says so: the command line, the scene, the file, or an assumption."""
    if given.needs is not None:
        return needs_from_option(given.needs), "--needs"
    if scene is not None:
        return scene.needs, f"scene {scene.name}"
    if data.needs is not None:
        return data.needs, "the data file"
    return Needs(joints=("revolute",) * data.degrees_of_freedom), "assumed: nothing states the needs"


def model_and_optimiser(
    given: Options, kind: str, sets: Split, needs: Needs, objective: Objective
) -> tuple[dict[str, Any], Optimiser | None, str]:
    """Description of the model, its optimiser, and why that one."""
    check_options(given, kind)
    properties, adam = CATALOGUE[kind].properties, given.optimizer == "adam"
    precision = given.precision or ("f32" if adam else "f64")
    if properties.searched:
        return describe_for(kind, sets.train, needs, precision=precision), None, ""
    if properties.kernel:
        sizes = resolved(given, {"samples": SAMPLES})
        return describe_for(kind, sets.train, needs, precision=precision, **sizes), None, ""
    if properties.linear:
        degree = 1 if given.degree is None else given.degree
        return describe_for(kind, sets.train, needs, precision=precision, degree=degree), None, ""
    # Structure needs fewer units, and first-order training more.
    width = 64 if adam else 8 if properties.definite else 16
    keywords = resolved(given, {"width": width, "depth": 2, "activation": "tanh"})
    require_positive(width=keywords["width"], depth=keywords["depth"])
    description = describe_for(kind, sets.train, needs, precision=precision, **keywords)
    optimizer, reason = given.optimizer, ""
    if optimizer == "auto":
        suited, reason = dynamics.suited_optimiser(build(description), sets, objective)
        optimizer = name_of(suited)
        precision = given.precision or ("f32" if optimizer == "adam" else "f64")
        description["precision"] = precision
    if optimizer == "gauss-newton":
        chosen = "auto chose gauss-newton" if reason else "the optimizer is gauss-newton"
        refuse_given(given, OF_ADAM, f"for adam, but {chosen}: add --optimizer adam")
    settings = {name: getattr(given, name) for name in (*OF_ADAM, "steps", "target")}
    return description, optimiser_named(optimizer, precision=precision, **settings), reason
