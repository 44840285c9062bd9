"""Trains value functions of published plants, and saves and loads their run folders."""

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

from dln_jax.control.optimal.fitted import Iteration, ValueProgress, fit_values
from dln_jax.control.optimal.plants import FITS, PLANTS, ValuePlant, ValueSettings, evaluate, starts
from dln_jax.control.optimal.problem import ControlProblem, ValueAndGradient, at_goal, hjb_policy
from dln_jax.control.optimal.residual import ResidualStage, discounts_down_to, fit_hjb
from dln_jax.control.optimal.value_networks import ValueNetwork, value_network
from dln_jax.control.state_space import Law
from dln_jax.files import as_type
from dln_jax.nn.activations import activation
from dln_jax.types import InputError
from dln_jax.zoo.parameter_files import REMEDY, load_manifest, load_tree, save_tree

VALUE = "value"
"""Stem of the pair of files in a run folder that holds the value function."""
OTHER_NAMES = {"furuta": "rotary-pendulum", "cartpole": "cart-pole"}
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
    """What the manifest of a value function states."""

    plant: str
    goal: tuple[float, ...] | None
    network: Family
    dtype: Literal["float32", "float64"]


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


def plant_named(name: str, goal: Sequence[float] | None = None) -> ValuePlant:
    """The plant with this name, with a posture [d] other than upright as its goal, if requested.

    Raises:
        InputError: an unknown name (the message lists all), or a goal of the wrong length or that no control can hold.
    """
    name = OTHER_NAMES.get(name, name)
    if name not in PLANTS:
        raise InputError(f"plant '{name}' is unknown; choose from {', '.join(PLANTS)}")
    plant = PLANTS[name]()
    if goal is None:
        return plant
    d = len(plant.problem.goal) // 2
    if len(goal) != d:
        raise InputError(f"the goal has {len(goal)} coordinates; expected the posture of {name}, which has {d}")
    return plant._replace(problem=at_goal(plant.problem, [*goal, *np.zeros(d)]))


def family_of(plant: ValuePlant, family: Family) -> ValueNetwork:
    """The networks of a family for a plant."""
    return value_network(plant.problem, **{**dataclasses.asdict(family), "activation": activation(family.activation)})


def usual(name: str, method: str) -> ValueSettings:
    """Default network and training settings of a plant."""
    if method not in METHODS:
        raise InputError(f"method '{method}' is unknown; choose from {', '.join(METHODS)}")
    if method == "residual":
        return ValueSettings((24, 24), Iteration(), 30.0)
    return FITS.get(OTHER_NAMES.get(name, name), FITS["cart-pole"])


def by_iteration(
    plant: ValuePlant,
    family: Family,
    numbers: Iteration,
    seeds: Sequence[int],
    report: Report,
    mesh: Mesh | None = None,
) -> list[Trained]:
    """Fits value functions by fitted value iteration, one per seed; devices share the states."""
    done, total = itertools.count(1), len(seeds) * numbers.iterations

    def report_progress(at: ValueProgress) -> None:
        report(next(done), total, f"cost and misfit {at.validation:.4g}")

    fits = fit_values(
        plant.problem, family_of(plant, family), seeds, numbers=numbers, mesh=mesh, report=report_progress
    )
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
) -> list[Trained]:
    """Fits value functions by the residual of the Hamilton-Jacobi-Bellman equation, one per seed.

    Devices of a mesh share the samples.
    """
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
            discounts=discounts, iterations=iterations, rounds=ROUNDS, mesh=mesh, report=report_progress,
        )  # fmt: skip
        trained.append(Trained(solution.parameters, solution.validation, time.perf_counter() - began))
    return trained


def measured(plant: ValuePlant, law: Law, *, count: int = 100, seed: int = 0) -> dict[str, float]:
    """Returns of a law in the published evaluation, from both kinds of starts; a failed start counts as NaN."""
    numbers: dict[str, float] = {}
    for where in ("down", "uniform"):
        evaluation = evaluate(plant, law, starts(plant, where, count, seed))
        numbers |= {
            f"{where}_return_mean": float(np.mean(evaluation.returns)),
            f"{where}_return_median": float(np.median(evaluation.returns)),
            f"{where}_return_worst": float(np.min(evaluation.returns)),
            f"{where}_up_share": float(np.mean(np.isfinite(evaluation.settled))),
            f"{where}_settled_median_seconds": float(np.median(evaluation.settled)),
            f"{where}_control_most": evaluation.largest,
        }
    return numbers


def save_value(folder: Path, plant: str, goal: Sequence[float] | None, family: Family, parameters: Any) -> None:
    """Writes value.json and value.safetensors."""
    facts = {
        "plant": OTHER_NAMES.get(plant, plant),
        "goal": None if goal is None else list(goal),
        "network": {**dataclasses.asdict(family), "widths": list(family.widths)},
        "dtype": str(jax.tree.leaves(parameters)[0].dtype),
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
        plant = plant_named(stored.plant, stored.goal)
        network = family_of(plant, Family(**dataclasses.asdict(stored.network)))
    except InputError as error:
        raise InputError(f"{path}: {error}; {REMEDY}") from None
    dtype = jnp.dtype(stored.dtype)

    def parameters(key: Array) -> Any:
        return jax.tree.map(lambda leaf: leaf.astype(dtype), network.init(key))

    like = jax.eval_shape(parameters, jax.random.key(0))
    return ValueRun(stored.plant, plant, network, load_tree(folder, VALUE, like))
