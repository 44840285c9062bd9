"""Train a value function: a network for the cost to go of a plant, whose gradient gives the optimal control.

Trains by fitted value iteration, or on the residual of the Hamilton-Jacobi-Bellman equation. Prints the training time
and the returns of the law in the published evaluation (100 starts), and writes a run folder: value.safetensors and
value.json (load them with dln_jax.training.values.load_value), metrics.json and config.json.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from dln_jax.cli.arguments import Unstated, choice


@dataclass(frozen=True)
class TrainingOptions:
    """Plant, method and networks."""

    plant: Annotated[str | None, choice(PLANTS, unstated=True)] = None
    """The plant and its costs (default: pendulum)."""
    method: Annotated[str | None, choice(METHODS, unstated=True)] = None
    """fitted: value iteration along trajectories of the model; residual: least squares on the equation, by
    Levenberg-Marquardt (default: fitted)."""
    goal: Unstated[str] = None
    """Posture to hold, rad or m, separated by commas (default: upright)."""
    width: Unstated[int] = None
    """Units of a hidden layer (default: 96; residual: 24)."""
    depth: Unstated[int] = None
    """Number of hidden layers (default: 3; residual: 2)."""
    members: Unstated[int] = None
    """Number of networks, whose mean is V (default: 1)."""
    iterations: Unstated[int] = None
    """Iterations of value iteration (default: 48 or 80 by the plant), or per discount (residual; default: 15)."""
    seed: int = 0
    """Seed of parameters and states."""
    seeds: int = 1
    """Number of trainings, of which the one with the best validation is kept."""
    starts: int = 100
    """Number of starts of the evaluation, as many hanging as anywhere."""
    stored: Unstated[Path] = None
    """Folder of a run whose value function is evaluated on its own plant, without training; then only --starts, --out
    and --devices apply (default: train one)."""


def main(options: Arguments) -> None:
    """Trains and evaluates a value function, or evaluates a stored one, and writes the run folder."""
    mesh = mesh_of(options)
    require_positive(seeds=options.seeds, starts=options.starts)
    require_seed(options.seed, options.seeds)
    require_positive_if_given(options, ("width", "depth", "members", "iterations"))
    if options.stored is not None:
        evaluate_stored(options, options.stored)
        return
    options = dataclasses.replace(options, plant=options.plant or "pendulum", method=options.method or "fitted")
    name, method = str(options.plant), str(options.method)
    goal = None if options.goal is None else numbers_of("--goal", options.goal)
    plant = plant_named(name, goal)
    fit = usual(name, method)
    width, depth = options.width or fit.widths[0], options.depth or len(fit.widths)
    family = Family((width,) * depth, options.members or 1, scale=fit.scale)
    with command_folder(options, "train_value", family=family._asdict()) as folder:
        print(f"{name}: {method}, {family.members} x {depth} layers of {width}")
        trained = train(options, plant, family, fit.numbers, mesh)
        best = min(trained, key=lambda training: training.validation)
        save_value(folder, name, goal, family, best.parameters)
        numbers = {"train_seconds": best.train_seconds, "validation": best.validation}
        if len(trained) > 1:
            numbers |= over_seeds(trained)
        finish(folder, ValueRun(name, plant, family_of(plant, family), with_float64(best.parameters)), options, numbers)


OF_TRAINING = ("plant", "method", "goal", "width", "depth", "members", "iterations", "seed", "seeds")


def evaluate_stored(options: Arguments, stored: Path) -> None:
    """Evaluates a stored value function on its own plant; `InputError` for options that only training uses."""
    unused = [name for name in OF_TRAINING if getattr(options, name) != getattr(Arguments(), name)]
    if unused:
        raise InputError(
            f"--{unused[0]} does not go with --stored: the stored value function has its own plant and network; "
            f"leave out --{unused[0]}, or leave out --stored to train"
        )
    run = load_value(stored)
    with command_folder(dataclasses.replace(options, plant=run.name), "train_value") as folder:
        finish(folder, dataclasses.replace(run, parameters=with_float64(run.parameters)), options, {})


def train(
    options: Arguments, plant: ValuePlant, family: Family, numbers: Iteration, mesh: Mesh | None
) -> list[Trained]:
    """Trains once per seed and shows the progress."""
    seeds = range(options.seed, options.seed + options.seeds)
    with contextlib.ExitStack() as stack:
        show: list[Callable[[int, str], None]] = []

        def report(done: int, total: int, text: str) -> None:
            if not show:
                show.append(stack.enter_context(progress(total, "iterations")))
            show[0](done, text)

        if options.method == "residual":
            return by_equation(plant, family, options.iterations or ITERATIONS, seeds, report, mesh)
        numbers = numbers._replace(iterations=options.iterations or numbers.iterations)
        return by_iteration(plant, family, numbers, seeds, report, mesh)


def over_seeds(trained: list[Trained]) -> dict[str, float]:
    """Median and worst validation, and median training time, over several seeds."""
    validation = [training.validation for training in trained]
    return {
        "validation_median": float(np.median(validation)),
        "validation_worst": float(np.max(validation)),
        "train_seconds_median": float(np.median([training.train_seconds for training in trained])),
    }


def finish(folder: Path, run: ValueRun, options: Arguments, numbers: dict[str, float]) -> None:
    """Evaluates a value function, prints the numbers and writes them to metrics.json."""
    numbers = numbers | measured(run.plant, run.law, count=options.starts)
    write_json(folder / "metrics.json", {key: finite(value) for key, value in numbers.items()})
    rows = [[key.replace("_", " "), f"{value:.4g}", "s" if "seconds" in key else ""] for key, value in numbers.items()]
    print_numbers(rows, title=f"returns from {options.starts} starts hanging, and anywhere")
    print(f"run folder: {folder}")
