"""--model auto: fits a sequence of candidate models and selects one by validation."""

import dataclasses
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh
from rich.console import Console
from rich.table import Table

from dln_jax.data.encoders.sampling import noise_of
from dln_jax.data.robots import Robot
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import every
from dln_jax.data.stated_needs import needs_from_json
from dln_jax.files import is_file, read_json, write_json
from dln_jax.identification.identify import identify, parameters_of
from dln_jax.identification.residual import fit_residual, inner_split, with_network
from dln_jax.identification.rigid_tree import build_rigid_tree, describe_rigid_tree
from dln_jax.learning.engine.problem import Training
from dln_jax.learning.linear import MOST_PARAMETERS, parameters_of_degree
from dln_jax.learning.model_selection import Assessment, Candidate, FittedModel, Selection, select_model
from dln_jax.learning.objectives import SCALED_TORQUE, Objective, require_scales
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees.description import tree_to_json
from dln_jax.models.model import Model, Parameters
from dln_jax.models.rigid_tree import USUAL, RigidTreeParameters
from dln_jax.models.serial_tree import tree_of
from dln_jax.runs.arguments import class_with, require_positive_if_given
from dln_jax.training.dynamics.methods.direct import training_of
from dln_jax.training.dynamics.methods.learned_tree import needs_of_tree
from dln_jax.training.dynamics.options import NETWORK, Options, SelectionOptions, options_of
from dln_jax.training.dynamics.recorded import Recorded
from dln_jax.training.dynamics.task import Method, Task, method_of, planned
from dln_jax.training.dynamics.verdict import definiteness_of
from dln_jax.zoo.descriptions import Description, build, describe
from dln_jax.zoo.run import load, save

SELECTION_SECONDS, CANDIDATE_SECONDS = 300.0, 120.0
"""Default time limits, s: for the whole selection, and for one search or network in it."""
MOST_SAMPLES = 4_000
"""Largest number of samples for fitting residual networks."""
EXPLICIT, KERNEL = "trigonometric", "trigonometric-kernel"
CANDIDATES, CANDIDATE = "candidates", "candidate"
"""Folder of the candidates' models in that of the run, and stem of the file that says how a fit ended."""
BESIDE = "-residual"
"""Suffix of the name of a model with a residual network."""


def plan(options: SelectionOptions, kind: str, recorded: Recorded, objective: Objective) -> tuple[dict[str, Any], None]:
    """Plans no description, because the selected model brings its own."""
    require_positive_if_given(options, ["seconds"])
    require_scales(recorded.sets.train)
    return {}, None


def fit(task: Task, options: Any, folder: Path, mesh: Mesh | None) -> tuple[Task, Training]:
    """Fits the candidates, prints them and writes them to `model_selection.json`; returns the selected one.

    The devices of a mesh share the final network; all other candidates are fitted on one device.

    Raises:
        InputError: no model could be fitted.
    """
    recorded = task.recorded
    train_set, validation, _ = recorded.sets
    noise = noise_of(train_set.tau, train_set.trajectory)
    selection = select_model(
        _candidates(options, recorded, folder, mesh),
        train_set,
        validation,
        noise=noise if np.isfinite(noise).all() and noise.all() else None,
        seconds=SELECTION_SECONDS if options.seconds is None else task.seconds,
        definite=lambda fitted: is_definite(fitted, validation),
        report=report,
    )
    print_selection(selection)
    write_json(folder / "model_selection.json", as_json(selection))
    return selection.fitted.outcome


def is_definite(fitted: FittedModel, data: Trajectories) -> bool:
    """Whether the mass matrices of a model are positive definite at the states of the data; true without any."""
    with jax.enable_x64(True):
        task, mechanics = fitted.outcome[0], dynamics(fitted.model.energies(fitted.parameters))
        definite = definiteness_of(mechanics, task, data)
    return definite is None or definite.share_not_definite == 0


def report(step: Assessment) -> None:
    """Prints the result of a candidate as soon as it is available."""
    if not step.tried:
        return
    if step.nmse is None:
        print(f"{step.name}: {step.reason}")
    else:
        worst = f"worst joint {step.nmse.max():.3g}"
        print(f"{step.name}: validation nMSE {step.nmse.mean():.3g}, {worst}, {step.seconds:.1f} s")


def print_selection(selection: Selection) -> None:
    """Prints a table of all candidates, and why the selection ended."""
    title = "candidates, by errors on validation motions"
    table = Table("model", "nMSE, mean", "nMSE, worst joint", "s", "", title=title)
    for step in selection.steps:
        numbers = ["", "", ""]
        if step.nmse is not None:
            numbers = [f"{step.nmse.mean():.2e}", f"{step.nmse.max():.2e}", f"{step.seconds:.1f}"]
        state = "none" if step.nmse is None else "" if step.definite else "indefinite masses"
        state = f"kept {state}".strip() if step is selection.chosen else state if step.tried else "not tried"
        table.add_row(step.name, *numbers, state)
    Console(highlight=False, soft_wrap=True).print(table)
    if selection.ended:
        print(f"no further model was tried: {selection.ended}")


def as_json(selection: Selection) -> dict[str, Any]:
    """Contents of `model_selection.json`."""
    candidates = [
        {
            "name": step.name,
            "tried": step.tried,
            "validation_nmse": None if step.nmse is None else float(step.nmse.mean()),
            "validation_nmse_joints": None if step.nmse is None else step.nmse.tolist(),
            "definite": step.definite,
            "seconds": step.seconds,
            "reason": step.reason,
        }
        for step in selection.steps
    ]
    return {"kept": selection.chosen.name, "ended": selection.ended, "candidates": candidates}


def _candidates(options: Any, recorded: Recorded, folder: Path, mesh: Mesh | None) -> list[Candidate]:
    """The candidates, from the strongest prior knowledge to the weakest."""
    bases: dict[str, FittedModel | str] = {}

    def stored(name: str, fit: Callable[[float], FittedModel | str]) -> Candidate:
        return Candidate(name, lambda left: _stored(folder / CANDIDATES / name, options.resume, recorded, fit, left))

    def both(name: str, fit: Callable[[float], FittedModel]) -> list[Candidate]:
        own, beside = (
            stored(name, fit),
            stored(name + BESIDE, lambda left: _with_network(recorded, bases.get(name), left)),
        )

        def base(left: float) -> FittedModel | str:
            bases[name] = own.fit(left)
            return bases[name]

        return [Candidate(name, base), beside]

    def by_name(name: str) -> Callable[[float], FittedModel]:
        return lambda left: _by_name(name, options, recorded, folder, mesh, left)

    robot = recorded.robot
    known = [] if robot is None else both("rigid-tree", lambda left: _rigid_tree(options, recorded, robot))
    learned = both("learned-tree", by_name("learned-tree"))
    first, second = (parameters_of_degree(recorded.needs, degree) for degree in (1, 2))
    # A small basis is fitted within a second; a search for joint frames takes half a minute.
    small = second is not None and second <= MOST_PARAMETERS
    explicit = (
        both(EXPLICIT, by_name(EXPLICIT))
        if first is not None and first <= MOST_PARAMETERS
        else [Candidate(EXPLICIT, _too_large(first))]
    )
    kernel = [] if small else both(KERNEL, by_name(KERNEL))
    order = [known, explicit, learned, kernel] if small else [known, learned, explicit, kernel]
    direct = [candidates[0] for candidates in order if candidates]
    return [
        *direct,
        *(candidate for candidates in order for candidate in candidates[1:]),
        Candidate(NETWORK, by_name(NETWORK)),
    ]


def _stored(
    place: Path, resume: bool, recorded: Recorded, fit: Callable[[float], FittedModel | str], left: float
) -> FittedModel | str:
    """Fits a candidate and stores it in a folder of its own, or takes it from there if the run is resumed.

    A learned tree is fitted again: its verdict needs the search.
    """
    done = place / f"{CANDIDATE}.json"
    if resume and is_file(done):
        facts = read_json(done, remedy=f"remove {place}")
        if facts.get("reason"):
            return str(facts["reason"])
        run = load(place)
        recorded = recorded._replace(needs=needs_from_json(run.description["needs"]))
        return _as_training(recorded, run.description, build(run.description), run.parameters, float(facts["seconds"]))
    began = time.perf_counter()
    fitted = fit(left)
    place.mkdir(parents=True, exist_ok=True)
    if isinstance(fitted, str):
        write_json(done, {"reason": fitted})
        return fitted
    task: Task = fitted.outcome[0]
    save(place, task.description, fitted.parameters)
    if task.search is None:
        write_json(done, {"seconds": time.perf_counter() - began})
    return fitted


def _too_large(size: int | None) -> Callable[[float], str]:
    """Returns the fit of a candidate that is too large: it gives only the reason."""
    number = "too many" if size is None else f"{size:,}"
    return lambda left: f"its basis has {number} coefficients; at most {MOST_PARAMETERS:,} are tried"


def _by_name(name: str, options: Any, recorded: Recorded, folder: Path, mesh: Mesh | None, left: float) -> FittedModel:
    """Trains a model as `--model NAME` would, with the common options and the defaults of its fit."""
    limit = min(left, CANDIDATE_SECONDS if options.seconds is None else math.inf)
    common = {field.name: getattr(options, field.name) for field in dataclasses.fields(Options)}
    own = class_with(Options, options_of({"model": name}))(**{**common, "model": name})
    task = planned(own, name, recorded, time.perf_counter() + limit)
    task, training = method_of(name).fit(task, own, folder, mesh)
    return FittedModel(build(task.description), training.parameters, (task, training))


def _rigid_tree(options: Any, recorded: Recorded, robot: Robot) -> FittedModel:
    """Identifies the robot's tree as the command `identify` does."""
    train_set = recorded.sets.train
    began = time.perf_counter()
    description, _, _ = describe_rigid_tree(robot, recorded.needs, train_set, velocity_scale=options.velocity_scale)
    model, known = build_rigid_tree(description, robot)
    solution = identify(model, known, train_set, joints=robot.tree.joints)
    kept = parameters_of(solution.theta, known)
    return _as_training(recorded, description, model, kept, time.perf_counter() - began)


def _with_network(recorded: Recorded, base: FittedModel | str | None, left: float) -> FittedModel | str:
    """Adds a residual network to a model if held-out motions justify it.

    Its size is chosen on a part of the training set: chosen on the motions that the candidates are compared by, it
    would fit them.
    """
    if not isinstance(base, FittedModel):
        return "there is no model to add a network to"
    began = time.perf_counter()
    if base.outcome[0].kind == "learned-tree":
        base = _as_rigid(base, recorded)
    train_set, chosen_by = inner_split(recorded.sets.train)
    thin = -(-len(train_set.t) // MOST_SAMPLES)
    added = fit_residual(
        base.model,
        base.parameters,
        recorded.needs,
        every(train_set, thin),
        chosen_by,
        seconds=min(left, CANDIDATE_SECONDS),
    )
    if not added.settings:
        return "no network makes it better on validation motions"
    description = with_network(base.outcome[0].description, added)
    return _as_training(recorded, description, added.model, added.parameters, time.perf_counter() - began)


def _as_rigid(learned: FittedModel, recorded: Recorded) -> FittedModel:
    task: Task = learned.outcome[0]
    needs, stated, solution = needs_of_tree(recorded.needs), task.description, learned.parameters
    tree = tree_of(solution, needs, parents=stated["parents"], acceleration=stated["acceleration"])
    laws = USUAL if needs.friction else ()
    description = describe(
        "rigid-tree",
        precision="f64",
        needs=needs._replace(friction=False, joint_friction=laws),
        tree=tree_to_json(tree),
        velocity_scale=stated["velocity_scale"],
    )
    parameters = RigidTreeParameters(
        solution.inertias, solution.armature, solution.viscous, solution.coulomb, solution.offset
    )
    return _as_training(recorded, description, build(description), parameters, 0.0)


def _as_training(
    recorded: Recorded, description: Description, model: Model, parameters: Parameters, seconds: float
) -> FittedModel:
    """Wraps a fit as a task and its training, as for models trained by name."""
    task = Task(recorded, description["name"], description, SCALED_TORQUE, None, 0, math.inf)
    return FittedModel(model, parameters, (task, training_of(task, parameters, float("nan"), seconds)))


METHOD = Method(plan, fit)
