"""Train a structured deep Lagrangian network on trajectories (q, qd, qdd, tau), and report its errors and its speed.

Without --data it trains on the embedded set: the tip of a two-link arm writes 20 letters, of which e, q and v are the
test. A run folder gets config.json, metrics.json, model.safetensors and model.json (load them with
dln_jax.load_run), a checkpoint to --resume from, and figures.
"""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from dln_jax.data import schema
from dln_jax.data.schema import Trajectories, needs_from_json
from dln_jax.data.splits import Split, merged, split
from dln_jax.deploy.load import build, load_run, save_model
from dln_jax.evaluation import figures
from dln_jax.evaluation.latency import one_step
from dln_jax.evaluation.metrics import errors, predictions
from dln_jax.learning.train import Progress, Settings, Training, check, data_type, has_checkpoint, train
from dln_jax.scenes.scene import Scene
from dln_jax.scenes.two_link_arm import two_link_arm
from dln_jax.types import InputError, Needs, require_positive
from scripts.command_line import new_folder, run, scene_named, write_json
from scripts.default_data import CHARACTERS_TEST, default_data
from scripts.progress import progress


@dataclass(frozen=True)
class Arguments:
    """What to train on, how, and where the results go."""

    data: Path | None = None
    """Trajectories in the npz schema (default: the embedded characters, or random states of --scene)."""
    test: str | None = None
    """Labels of the test trajectories, comma separated (default: e,q,v of the embedded set, else every sixth)."""
    scene: str | None = None
    """Textbook scene whose needs the data have; without --data, the scene to sample."""
    needs: str | None = None
    """What the plant needs, as JSON, for example '{"joints": ["revolute", "prismatic"], "friction": true}'
    (default: what the scene or the file states, else revolute joints with gravity)."""
    width: int = 64
    """Hidden units per layer."""
    depth: int = 2
    """Hidden layers."""
    activation: str = "tanh"
    """Of the hidden layers: tanh, softplus, silu, gelu, sin or cos."""
    steps: int = 20_000
    """Optimiser steps."""
    batch: int = 512
    """Samples per step."""
    learning_rate: float = 5e-3
    """Peak of the warm-up and cosine schedule."""
    weight_decay: float = 1e-5
    """Of AdamW."""
    patience: int = 10_000
    """Steps without a better validation error after which training stops."""
    precision: Literal["f32", "f64"] = "f32"
    """Floating-point type of the model and its training."""
    seed: int = 0
    """Of the initial parameters, the shuffling and the validation split."""
    out: Path | None = None
    """Folder of the run (default: runs/train_delan-1, -2, ...)."""
    resume: bool = False
    """Continue the run in --out with the settings it was started with."""
    figures: bool = True
    """Draw the figures."""


PLACES = ("out", "resume", "figures")
"""Arguments that do not decide the result."""
CONFIG = "config.json"


class Task(NamedTuple):
    """What the arguments come to: the data, what they need, and the model to train."""

    name: str
    sets: Split
    scene: Scene | None
    needs: Needs
    needs_origin: str
    description: dict[str, Any]
    """Of the model, for `dln_jax.deploy.load.build`."""
    settings: Settings


def main(given: Arguments) -> None:
    """Trains, evaluates, and writes the run folder."""
    console = Console(highlight=False, soft_wrap=True)
    if given.resume:
        given = with_stored_settings(given)
    task = prepare(given)
    model = build(task.description)
    folder = given.out if given.resume and given.out else new_folder(given.out, "train_delan")
    write_json(folder / CONFIG, stored_settings(given))
    announce(console, task)
    with progress(task.settings.steps) as show:

        def report(at: Progress) -> None:
            text = f"loss {at.loss:.2e}  validation {at.validation:.2e} (N m)²"
            show(min(int(at.step), task.settings.steps), text)

        training = train(
            model,
            task.sets,
            task.settings,
            directory=folder,
            resume=given.resume and has_checkpoint(folder),
            report=report,
        )
    save_model(folder, task.description, training.parameters)
    metrics = evaluate(folder, task, training, draw=given.figures)
    write_json(folder / "metrics.json", metrics)
    console.print(results_table(metrics, task))
    console.print(f"run folder: {folder}")
    if training.stop.reason == "no improvement":
        console.print(f"stopped early, at step {training.stop.step}: no better validation error for --patience steps")
    if training.stop.reason == "not finite":
        raise InputError(
            f"the loss stopped being finite after step {training.stop.step}; {folder} holds the last good model; "
            "lower --learning-rate or use --precision f64"
        )


def prepare(given: Arguments) -> Task:
    """Reads and checks everything that the arguments name, before anything is written."""
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
    require_positive(width=given.width, depth=given.depth)
    description = {
        "kind": "structured-delan",
        "needs": needs._asdict(),
        "width": given.width,
        "depth": given.depth,
        "activation": given.activation,
        "diagonal_shift": 2.0,
        "diagonal_floor": 0.1,
        "precision": given.precision,
    }
    settings = Settings(**{field: getattr(given, field) for field in Settings._fields})
    sets = split(data._replace(needs=needs), test=labels, seed=given.seed)
    check(sets, settings)
    return Task(name, sets, scene, needs, origin, description, settings)


def stated_needs(given: Arguments, scene: Scene | None, data: Trajectories) -> tuple[Needs, str]:
    """What the plant needs, and who says so: the command line, the scene, the file, or an assumption."""
    if given.needs is not None:
        try:
            return needs_from_json(json.loads(given.needs)), "--needs"
        except json.JSONDecodeError as error:
            raise InputError(f"--needs is not JSON ({error}); see --help for an example") from error
    if scene is not None:
        return scene.needs, f"scene {scene.name}"
    if data.needs is not None:
        return data.needs, "the data file"
    return Needs(joints=("revolute",) * data.degrees_of_freedom), "assumed: nothing states the needs"


def stored_settings(given: Arguments) -> dict[str, Any]:
    """The arguments that decide the result, as JSON values."""
    values = dataclasses.asdict(given)
    return {key: str(v) if isinstance(v, Path) else v for key, v in values.items() if key not in PLACES}


def with_stored_settings(given: Arguments) -> Arguments:
    """The arguments that the run in --out was started with; what is given anew must not differ."""
    if given.out is None or not (given.out / CONFIG).is_file():
        raise InputError(f"--resume continues the run in --out, but {given.out or '--out'} holds none; name its folder")
    stored = json.loads((given.out / CONFIG).read_text())
    for key, value in stored_settings(given).items():
        if value not in (stored.get(key), stored_settings(Arguments())[key]):
            raise InputError(f"the run in {given.out} was started with {key} = {stored.get(key)}; leave --{key} out")
    stored["data"] = None if stored["data"] is None else Path(stored["data"])
    return dataclasses.replace(given, **stored)


def announce(console: Console, task: Task) -> None:
    """Says what is trained on what, and what was assumed."""
    counts = ", ".join(f"{len(part.t)} {role}" for role, part in task.sets._asdict().items())
    joints = "-".join(task.needs.joints)
    terms = [name for name in ("gravity", "friction") if getattr(task.needs, name)] or ["no potential, no friction"]
    console.print(f"{task.name}: {counts} samples")
    console.print(f"{joints} with {' and '.join(terms)} ({task.needs_origin})")
    if task.sets.train.estimated:
        console.print(f"not in the data: {', '.join(task.sets.train.estimated)}; rates are finite differences")


def evaluate(folder: Path, task: Task, training: Training, *, draw: bool) -> dict[str, float]:
    """Loads the stored model as a user would, measures it on the test trajectories, and draws it."""
    dtype = data_type(task.settings.precision)
    dynamics = load_run(folder)
    test = task.sets.test
    predicted = predictions(dynamics, test, dtype)
    states = list(zip(*(jnp.asarray(a[:512], dtype) for a in (test.q, test.qd, test.qdd)), strict=True))
    latency = one_step(dynamics.inverse_dynamics, states)
    if draw:
        figures.force_decomposition(test, predicted).savefig(folder / "decomposition.png")
        if training.history:
            curve = figures.training_curve(training.history, best_step=training.best_step)
            curve.savefig(folder / "training.png")
        if task.scene is not None and task.scene.tip is not None:
            paths = figures.tip_paths(merged(task.sets), task.scene.tip, test=np.unique(test.trajectory).tolist())
            paths.savefig(folder / "tip_paths.png")
    validation = {"validation_mse": min(at.validation for at in training.history)} if training.history else {}
    return {
        **errors(predicted, test),
        **validation,
        "parameters": sum(leaf.size for leaf in jax.tree.leaves(training.parameters)),
        "steps": training.stop.step,
        "best_step": training.best_step,
        "compile_seconds": training.compile_seconds,
        "train_seconds": training.train_seconds,
        "one_step_p50_us": latency.p50_us,
        "one_step_p99_us": latency.p99_us,
    }


def results_table(metrics: dict[str, float], task: Task) -> Table:
    """The figures that a user wants to see, with units."""
    force = "N m" if set(task.needs.joints) == {"revolute"} else "N m or N"
    units = {"power_mse": "W²", "forward_mse": "(1/s²)²"}
    table = Table("quantity", "value", "unit", title=f"test on {task.name}, {task.settings.precision}")
    table.columns[1].justify = "right"
    for key, value in metrics.items():
        unit = units.get(key, f"({force})²" if key.endswith("_mse") else "")
        unit = "s" if key.endswith("_seconds") else "µs" if key.endswith("_us") else unit
        small = f"{value:.2e}" if key.endswith("_mse") else f"{value:,.1f}"
        table.add_row(key.replace("_", " "), f"{value:,}" if isinstance(value, int) else small, unit)
    table.add_row("one-step rate", f"{1e6 / metrics['one_step_p50_us']:,.0f}", "calls/s")
    return table


if __name__ == "__main__":
    run(main, Arguments)
