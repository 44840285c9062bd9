"""Programs that evaluate a model of dynamics, with its parameters as arguments so that they compile while it trains."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from dln_jax.compilation import in_background, quick_compilation
from dln_jax.data.schema import Trajectories
from dln_jax.learning.linear import design
from dln_jax.mechanics.equations import dynamics
from dln_jax.metrics.errors import prediction_program, samples_of
from dln_jax.metrics.motions import Records, metrics_of_motions, motion_program, records_of
from dln_jax.models.model import Model
from dln_jax.precision import data_type
from dln_jax.training.dynamics.task import Task
from dln_jax.training.uncertainty import CHUNK
from dln_jax.types import InputError
from dln_jax.zoo.descriptions import build


class Programs(NamedTuple):
    """Programs that evaluate the model of a task for any parameters."""

    model: Model
    double: Model
    """The same model in float64, whose torques are linearised in the parameters."""
    predict: Any
    """(parameters, samples) -> predictions for test and validation."""
    follow: Any
    """(parameters, records of the test) -> motions and energies."""
    ceilings: Callable[[], dict[str, float]]
    """() -> metrics of the true plant's rollouts; empty for an unknown scene or a test without motions."""


def programs_of(task: Task, mesh: Mesh | None) -> Programs:
    """Returns programs that compile on their first call."""
    model = build(task.description)
    predict = prediction_program(model.energies, mesh=mesh)
    follow = motion_program(lambda parameters: dynamics(model.energies(parameters)))
    double = model if task.precision == "f64" else build({**task.description, "precision": "f64"})
    return Programs(model, double, compiled(predict), compiled(follow), lambda: plant_metrics(task))


def compiled(function: Callable[..., Any]) -> Any:
    """`jax.jit` for programs that run once or twice each, with quick compilation."""
    return jax.jit(function, compiler_options=quick_compilation())


def programs_ahead(task: Task, mesh: Mesh | None, *, uncertainty: bool) -> Programs:
    """Returns programs that compile in a background thread while the model trains.

    Args:
        task: a model that an optimiser trains, with a final description.
        mesh: devices that share the samples; their programs compile on their first call.
        uncertainty: whether the torques will be linearised in the parameters.
    """
    programs = programs_of(task, mesh)
    if mesh is not None:
        return programs
    parameters = jax.eval_shape(programs.model.init, jax.random.key(0))
    samples = samples_of(judged_data(task), data_type(task.precision))
    records = records_or_none(task)

    def compile_all() -> tuple[Callable, Callable, dict[str, float]]:
        if uncertainty:
            linearise_once(programs.double, task)
        predict = programs.predict.lower(parameters, samples).compile()
        follow = programs.follow if records is None else programs.follow.lower(parameters, records).compile()
        return predict, follow, plant_metrics(task)

    ready = in_background(compile_all)
    return programs._replace(
        predict=lambda *arguments: ready()[0](*arguments),
        follow=lambda *arguments: ready()[1](*arguments),
        ceilings=lambda: ready()[2],
    )


def judged_data(task: Task) -> Trajectories:
    """Returns the test samples followed by the validation samples, so that one program predicts both."""
    test, validation = task.sets.test, task.sets.validation
    keys = [key for key in ("q", "qd", "qdd", "tau", "p", "pd") if getattr(test, key) is not None]
    return test._replace(**{key: np.concatenate([getattr(test, key), getattr(validation, key)]) for key in keys})


def records_or_none(task: Task) -> Records | None:
    """Returns the recorded test motions; `None` for independent states or motions of one sample."""
    test = task.sets.test
    if len(np.unique(test.trajectory)) == len(test.t):
        return None
    try:
        return records_of(test, data_type(task.precision))
    except InputError:
        return None


def plant_metrics(task: Task) -> dict[str, float]:
    """Returns the rollout metrics of the true plant, the upper bound for any model."""
    test = task.sets.test
    if task.scene is None or records_or_none(task) is None:
        return {}
    plant = dynamics(task.scene.energies)
    motions, energies = compiled(motion_program(lambda _: plant))(None, records_of(test, None))
    try:
        return metrics_of_motions(motions, energies, test)
    except InputError:  # a coordinate at rest; the metrics of the model report it
        return {}


def linearise_once(model: Model, task: Task) -> None:
    """Compiles `learning.linear.design` of the model by calling it."""
    with jax.enable_x64(True):
        parameters = jax.eval_shape(model.init, jax.random.key(0))
        zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape), parameters)
        state = np.ones((CHUNK, task.sets.test.q.shape[1]))
        design(model)(jax.tree.map(jnp.asarray, zeros), state, state, state)
