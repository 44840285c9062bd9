"""One model of the arm's table: trained, measured on the test, and timed."""

import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.data.splits import Split
from dln_jax.deploy.kinds import build, describe, objective_of
from dln_jax.deploy.load import compiled
from dln_jax.evaluation.definiteness import definiteness
from dln_jax.evaluation.latency import one_step
from dln_jax.evaluation.metrics import errors, predictions
from dln_jax.evaluation.rollouts import rollout_metrics
from dln_jax.learning.linear_fit import fit_linear
from dln_jax.learning.residuals import TORQUE
from dln_jax.learning.runs import Training
from dln_jax.learning.train import Settings, train
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.models.model import Model
from dln_jax.scenes.scene import Scene, dynamics
from dln_jax.types import Needs

TORQUE_NOISE = 0.05
"""N m, standard deviation, of the trigonometric model's second fit."""
TARGETS = (1.35e-5, 1e-8, 1e-9, 1e-10)
"""Test errors in (N m)² whose times are measured; the first is the published code's after 108 s."""


class Size(NamedTuple):
    """A network, and how long Gauss-Newton takes it to level off; chosen by validation errors."""

    width: int
    depth: int
    activation: str
    steps: int


SIZES = {
    "structured-delan": Size(8, 2, "tanh", 150),
    "structured-hnn": Size(8, 2, "tanh", 150),
    "black-box-delan": Size(16, 2, "tanh", 150),
    "black-box-hnn": Size(16, 2, "tanh", 150),
    "feed-forward": Size(16, 2, "tanh", 150),
}


class Curve(NamedTuple):
    """Test torque error against seconds of training, per seed, compilation included."""

    seconds: list[float]
    errors: list[float]


Measured = tuple[dict[str, float], Curve | None]


def needs_of(sets: Split) -> Needs:
    """The needs that the data state."""
    assert sets.train.needs is not None
    return sets.train.needs


def plant_rows(scene: Scene, sets: Split) -> Measured:
    """What the true plant reaches in rollouts: the ceiling of every model."""
    return rollout_metrics(dynamics(scene), sets.test), None


def measure_trigonometric(sets: Split) -> Measured:
    """The linear fit, and the same with noise on the training torques."""
    model = build(describe("trigonometric", sets.train, needs_of(sets), precision="f64", degree=1))
    began = time.perf_counter()
    fitted = fit_linear(model, sets.train)
    seconds = time.perf_counter() - began
    noise = TORQUE_NOISE * np.random.default_rng(0).standard_normal(sets.train.tau.shape)
    noisy = fit_linear(model, sets.train._replace(tau=sets.train.tau + noise))
    system = compiled(model.apply(fitted.parameters), jnp.float64)
    numbers = {
        **errors(predictions(system, sets.test, jnp.float64), sets.test),
        "noisy_torque_mse": torque_mse(model.apply(noisy.parameters), sets),
        **rollout_metrics(system, sets.test),
        "rank": float(fitted.rank),
        "condition": fitted.condition,
        "train_seconds": seconds,
        "parameters": float(fitted.parameter_count),
        **latency(system, sets),
    }
    return numbers, Curve([seconds], [max(numbers["torque_mse"], 1e-32)])


def measure_seeds(kind: str, sets: Split, *, seeds: int, steps: int | None) -> Measured:
    """Gauss-Newton on several seeds in one program; medians over them, and the spread of the torque error."""
    size = SIZES[kind]
    model, settings = prepared(kind, sets, size, steps)
    training = train(model, sets, settings, objective=objective_of(kind, sets.train), seeds=tuple(range(seeds)))
    seconds = training.compile_seconds + training.train_seconds
    of_seeds, systems = [], []
    for index in range(seeds):
        parameters = jax.tree.map(lambda leaf, index=index: leaf[index], training.parameters)
        system = compiled(model.apply(parameters), jnp.float64)
        systems.append(system)
        numbers = errors(predictions(system, sets.test, jnp.float64), sets.test)
        of_seeds.append({**numbers, **rollout_metrics(system, sets.test), **definite(kind, system, sets)})
    medians = {key: float(np.median([each[key] for each in of_seeds])) for key in of_seeds[0]}
    torques = [each["torque_mse"] for each in of_seeds]
    numbers = {
        **medians,
        "torque_mse_mean": float(np.mean(torques)),
        "torque_mse_standard_deviation": float(np.std(torques)),
        "torque_mse_largest": float(np.max(torques)),
        "compile_seconds": training.compile_seconds,
        "train_seconds": seconds / seeds,
        "parameters": float(sum(leaf.size for leaf in jax.tree.leaves(training.parameters)) // seeds),
        **latency(systems[0], sets),
    }
    return numbers, curve(kind, sets, training, numbers, seeds)


def measure_adam(kind: str, sets: Split, *, steps: int) -> Measured:
    """The published protocol: one seed, two layers of 64, batch 512, float32."""
    description = describe(kind, sets.train, needs_of(sets), precision="f32", width=64, depth=2, activation="tanh")
    model = build(description)
    training = train(model, sets, Settings(steps=steps), objective=objective_of(kind, sets.train))
    system = compiled(model.apply(training.parameters), jnp.float32)
    numbers = {
        **errors(predictions(system, sets.test, jnp.float32), sets.test),
        **rollout_metrics(system, sets.test, dtype=jnp.float32),
        "compile_seconds": training.compile_seconds,
        "train_seconds": training.compile_seconds + training.train_seconds,
        "parameters": float(sum(leaf.size for leaf in jax.tree.leaves(training.parameters))),
        **latency(system, sets, jnp.float32),
    }
    return numbers, curve(kind, sets, training, numbers, 1)


def gauss_newton_rows(sets: Split, *, seeds: int, steps: int | None) -> Measured:
    """Structured models trained one by one: seconds to test errors, compilation included, medians over seeds.

    Also the cost of ten seeds in one program in units of a single run, compilation included.
    """
    kind = "structured-delan"
    model, settings = prepared(kind, sets, SIZES[kind], steps)
    times: dict[float, list[float]] = {target: [] for target in TARGETS}
    final, singles = [], []
    for seed in range(seeds):
        jax.clear_caches()
        training = train(model, sets, settings._replace(seed=seed))
        for target in TARGETS:
            reached = [at.seconds for at in training.history if at.monitor <= target]
            times[target].append(training.compile_seconds + reached[0] if reached else float("inf"))
        final.append(torque_mse(model.apply(training.parameters), sets))
        singles.append(training.compile_seconds + training.train_seconds)
    jax.clear_caches()
    ten = train(model, sets, settings, seeds=tuple(range(10)))
    return {
        **{f"seconds_to_{target:g}": float(np.median(values)) for target, values in times.items()},
        "torque_mse": float(np.median(final)),
        "torque_mse_largest": float(np.max(final)),
        "train_seconds": float(np.median(singles)),
        "cost_of_ten_seeds": (ten.compile_seconds + ten.train_seconds) / float(np.median(singles)),
    }, None


def prepared(kind: str, sets: Split, size: Size, steps: int | None) -> tuple[Model, Settings]:
    """The model of a kind, and Gauss-Newton's settings for it."""
    keywords = {"width": size.width, "depth": size.depth, "activation": size.activation}
    model = build(describe(kind, sets.train, needs_of(sets), precision="f64", **keywords))
    return model, Settings(optimizer="gauss-newton", precision="f64", steps=steps or size.steps)


def curve(kind: str, sets: Split, training: Training, numbers: dict[str, float], seeds: int) -> Curve:
    """The path of the test error; its end alone for models that are not fitted to torques."""
    if objective_of(kind, sets.train) is not TORQUE:
        return Curve([numbers["train_seconds"]], [numbers["torque_mse"]])
    best: Array | np.ndarray = np.array([np.median(at.monitor) for at in training.history])
    seconds = [(training.compile_seconds + at.seconds) / seeds for at in training.history]
    return Curve(seconds, np.minimum.accumulate(best).tolist())


def definite(kind: str, system: Dynamics, sets: Split) -> dict[str, float]:
    """The share of test states whose learned mass matrix is not definite, for models without structure."""
    if not kind.startswith("black-box"):
        return {}
    return {"share_not_definite": definiteness(system, sets.test.q, sets.test.qd).share_not_definite}


def torque_mse(dynamics: Dynamics, sets: Split) -> float:
    """Test torque error in float64."""
    return errors(predictions(dynamics, sets.test, jnp.float64), sets.test)["torque_mse"]


def latency(system: Dynamics, sets: Split, dtype=jnp.float64) -> dict[str, float]:
    """Of one inverse-dynamics call."""
    states = list(zip(*(jnp.asarray(a[:400], dtype) for a in sets.test[1:4]), strict=True))
    return {"one_step_p50_us": one_step(system.inverse_dynamics, states, calls=2000).p50_us}
