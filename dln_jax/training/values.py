"""Trains value functions of published plants and of a user's own; saves, resumes and loads their run folders."""

import dataclasses
import functools
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh

from dln_jax.control.optimal.fitted import Iteration, IterationState, ValueProgress, fit_values
from dln_jax.control.optimal.own_plants import OwnProblem
from dln_jax.control.optimal.plants import Returns, ValuePlant, ValueSettings, Where, evaluate, starts
from dln_jax.control.optimal.problem import ControlProblem, ValueAndGradient, hjb_policy
from dln_jax.control.optimal.residual import ResidualStage, discounts_down_to, fit_hjb
from dln_jax.control.optimal.value_networks import ValueNetwork, value_network
from dln_jax.control.optimal.worst_case import Bounds, Disturbance, worst_disturbance
from dln_jax.control.state_space import Law
from dln_jax.files import as_type
from dln_jax.nn.activations import activation
from dln_jax.training.value_checkpoints import Kept
from dln_jax.training.value_plants import OTHER_NAMES, Chosen, OwnModel, plant_named, rebuilt, with_factors
from dln_jax.types import InputError
from dln_jax.zoo.descriptions import build
from dln_jax.zoo.parameter_files import MODEL, REMEDY, load_manifest, load_tree, save_tree
from dln_jax.zoo.run import read_description, save

VALUE = "value"
"""Stem of the pair of files in a run folder that holds the value function."""
METHODS = ("fitted", "residual")
ROUNDS = 6
"""Number of resamplings at the problem's own discount."""
ITERATIONS = 15
"""Gauss-Newton iterations per discount."""
Report = Callable[[int, int, str], None]
"""(iterations done, total iterations, result as text)."""


@dataclass(frozen=True)
class Family:
    """Arguments of `value_network` other than the problem, as JSON values."""

    widths: tuple[int, ...]
    members: int
    activation: str = "tanh"
    floor: float = 1e-3
    scale: float = 30.0


@dataclass(frozen=True)
class Stored:
    """Manifest of a value function."""

    plant: str
    goal: tuple[float, ...] | None
    network: Family
    dtype: Literal["float32", "float64"]
    own: OwnProblem | None = None
    """Problem of a user's own plant, whose model is in the same folder."""


class Trained(NamedTuple):
    """Value function of one seed."""

    parameters: Any
    validation: float
    train_seconds: float
    """Includes compilation."""


@dataclass(frozen=True, eq=False)
class ValueRun:
    """A value function loaded from its folder."""

    name: str
    """Name of the plant."""
    plant: ValuePlant
    network: ValueNetwork
    parameters: Any
    own: Chosen | None = None
    """A user's own plant and its model."""

    @property
    def problem(self) -> ControlProblem:
        """The control problem: dynamics and cost."""
        return self.plant.problem

    @functools.cached_property
    def value_and_gradient(self) -> ValueAndGradient:
        """x [n] -> V and V_x [n], jitted."""
        return jax.jit(lambda x: self.network.value_and_gradient(self.parameters, x))

    @functools.cached_property
    def law(self) -> Law:
        """x [n] -> u [m], jitted; NaN for a state that is not finite."""
        return jax.jit(hjb_policy(self.value_and_gradient, self.problem))


def family_of(plant: ValuePlant, family: Family) -> ValueNetwork:
    """The networks of a family for a plant."""
    return value_network(plant.problem, **{**dataclasses.asdict(family), "activation": activation(family.activation)})


def usual(chosen: Chosen, method: str) -> ValueSettings:
    """Default network and training settings of a plant."""
    if method not in METHODS:
        raise InputError(f"method '{method}' is unknown; choose from {', '.join(METHODS)}")
    if method == "residual":
        return ValueSettings((24, 24), Iteration(), 30.0 if chosen.own is None else chosen.settings.scale)
    return chosen.settings


def worst_of(chosen: Chosen, share: float) -> Disturbance | None:
    """Worst-case errors of the plant's uncertain numbers, up to a share of each; `None` for a share of 0.

    Raises:
        InputError: a share that is not between 0 and 1.
    """
    if not 0 <= share < 1:
        raise InputError(f"robust is {share}; expected a share of masses and motors of at least 0 and less than 1")
    if share == 0:
        return None
    ones = np.ones(len(chosen.uncertain))
    return worst_disturbance(lambda x, u, p: chosen.altered(p)(x, u), ones, Bounds(parameters=share))


def by_iteration(
    plant: ValuePlant,
    family: Family,
    numbers: Iteration,
    seeds: Sequence[int],
    report: Report,
    mesh: Mesh | None = None,
    *,
    disturbance: Disturbance | None = None,
    kept: Kept | None = None,
) -> list[Trained]:
    """Fits value functions by fitted value iteration, one per seed; devices share the states."""
    total = len(seeds) * numbers.iterations

    def report_progress(at: ValueProgress) -> None:
        report(numbers.iterations * place[0] + at.iteration, total, f"cost and misfit {at.validation:.4g}")

    place = [-1]

    def restore(seed: int, state: IterationState) -> IterationState:
        place[0] += 1
        return state if kept is None else kept.restore(seed, state)

    fits = fit_values(
        plant.problem, family_of(plant, family), seeds, numbers=numbers, mesh=mesh, disturbance=disturbance,
        report=report_progress, restore=restore, store=(lambda seed, state: None) if kept is None else kept.store,
    )  # fmt: skip
    return [
        Trained(fit.parameters, min(at.validation for at in fit.history), fit.train_seconds + fit.compile_seconds)
        for fit in fits
    ]


def by_equation(
    plant: ValuePlant,
    family: Family,
    iterations: int,
    seeds: Sequence[int],
    report: Report,
    mesh: Mesh | None = None,
    *,
    disturbance: Disturbance | None = None,
) -> list[Trained]:
    """Fits one value function per seed by the Hamilton-Jacobi-Bellman residual; devices of a mesh share the samples."""
    network, discounts = family_of(plant, family), discounts_down_to(plant.problem.discount)
    stages = len(discounts) - 1 + ROUNDS
    trained: list[Trained] = []
    for place, seed in enumerate(seeds):
        of_parameters, of_samples = jax.random.split(jax.random.key(seed))
        done, began = itertools.count(1 + place * stages), time.perf_counter()

        def report_progress(stage: ResidualStage, done: Iterator[int] = done) -> None:
            text = f"discount {stage.discount:.3g}/s, residual {stage.validation:.2e}"
            report(next(done), len(seeds) * stages, text)

        solution = fit_hjb(
            plant.problem, network.value_and_gradient, network.init(of_parameters), of_samples,
            discounts=discounts, iterations=iterations, rounds=ROUNDS, mesh=mesh, disturbance=disturbance,
            report=report_progress,
        )  # fmt: skip
        trained.append(Trained(solution.parameters, solution.validation, time.perf_counter() - began))
    return trained


def measured(chosen: Chosen, run: ValueRun, *, count: int = 100, seed: int = 0, share: float = 0.0) -> dict[str, float]:
    """Returns of a value function's law from both kinds of starts, and the error of V; a failed start counts as NaN.

    With a share, also on plants with masses larger and motors weaker by that share, and vice versa.
    """
    numbers: dict[str, float] = {}
    law = run.law
    where: Where
    for where in ("down", "uniform"):
        evaluation = evaluate(chosen.plant, law, starts(chosen.plant, where, count, seed))
        numbers |= {f"{where}_{key}": value for key, value in summary(evaluation).items()}
        numbers["value_error"] = value_error(run, evaluation)
    for name, sign in (("heavy_weak", 1), ("light_strong", -1)) if share else ():
        factors = [1 + sign * share * (-1 if of.startswith("strength") else 1) for of in chosen.uncertain]
        plant = chosen.plant._replace(problem=with_factors(chosen, factors))
        evaluation = evaluate(plant, law, starts(chosen.plant, "down", count, seed))
        numbers |= {f"{name}_{key}": value for key, value in summary(evaluation).items()}
    return numbers


def value_error(run: ValueRun, runs: Returns) -> float:
    """Median error of V, relative to the discounted cost of following its law; NaN unless a start ends up.

    Starts that are not up at the end of the evaluation are left out: their cost is not known.
    """
    problem, dt = run.problem, run.plant.evaluation.held / run.plant.evaluation.rate
    costs = jax.vmap(jax.vmap(lambda x, u: problem.state_cost(x) + problem.action_cost.cost(u)))
    weights = dt * np.exp(-problem.discount * dt * np.arange(runs.u.shape[1]))
    V = jax.vmap(run.value_and_gradient)(jnp.asarray(runs.x[:, 0]))[0]
    off = np.abs(V / (costs(runs.x[:, :-1], runs.u) @ weights) - 1)[np.isfinite(runs.settled)]
    return float(np.median(off)) if len(off) else float("nan")


def summary(evaluation: Returns) -> dict[str, float]:
    """Numbers of an evaluation."""
    return {
        "return_mean": float(np.mean(evaluation.returns)),
        "return_median": float(np.median(evaluation.returns)),
        "return_worst": float(np.min(evaluation.returns)),
        "up_share": float(np.mean(np.isfinite(evaluation.settled))),
        "settled_median_seconds": float(np.median(evaluation.settled)),
        "control_most": evaluation.largest,
    }


def save_value(
    folder: Path, plant: str, goal: Sequence[float] | None, family: Family, parameters: Any, own: OwnModel | None = None
) -> None:
    """Writes value.json and value.safetensors, and the model of a user's own plant."""
    if own is not None:
        save(folder, own.description, own.parameters)
    facts = {
        "plant": OTHER_NAMES.get(plant, plant),
        "goal": None if goal is None else list(goal),
        "network": {**dataclasses.asdict(family), "widths": list(family.widths)},
        "dtype": str(jax.tree.leaves(parameters)[0].dtype),
        "own": None if own is None else dataclasses.asdict(own.problem),
    }
    save_tree(folder, VALUE, parameters, facts)


def load_value(folder: str | Path) -> ValueRun:
    """Loads the value function from the folder of a run of train_value.

    Raises:
        InputError: there is none, or its files are damaged or of another release.
    """
    folder = Path(folder)
    path = folder / f"{VALUE}.json"
    stored = as_type(load_manifest(folder, VALUE), Stored, name=str(path), remedy=REMEDY)
    try:
        own = None if stored.own is None else rebuilt(stored.plant, _model_of(folder, stored.own))
        plant = plant_named(stored.plant, stored.goal) if own is None else own.plant
        network = family_of(plant, Family(**dataclasses.asdict(stored.network)))
    except InputError as error:
        raise InputError(f"{path}: {error}; {REMEDY}") from None
    dtype = jnp.dtype(stored.dtype)

    def parameters(key: Array) -> Any:
        return jax.tree.map(lambda leaf: leaf.astype(dtype), network.init(key))

    like = jax.eval_shape(parameters, jax.random.key(0))
    return ValueRun(stored.plant, plant, network, load_tree(folder, VALUE, like), own)


def _model_of(folder: Path, problem: OwnProblem) -> OwnModel:
    """The model in a value's folder, in its own precision whatever JAX's."""
    description = read_description(folder)
    with jax.enable_x64(True):
        like = jax.eval_shape(build(description).init, jax.random.key(0))
        parameters = jax.tree.map(np.asarray, load_tree(folder, MODEL, like))
    return OwnModel(description, parameters, problem)
