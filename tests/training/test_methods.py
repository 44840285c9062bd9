"""A new way of fitting is a method and two entries: the rest of the pipeline needs no change."""

from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import json_of

import dln_jax
from dln_jax.cli.arguments import arguments_of
from dln_jax.cli.commands import train_delan, train_hnn
from dln_jax.data import schema
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.models.model import Model
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.pendulums import pendulum
from dln_jax.training.dynamics.methods.direct import training_of
from dln_jax.training.dynamics.options import AUTO, FITS, VARIANTS, Fit, Options
from dln_jax.training.dynamics.run import run
from dln_jax.training.dynamics.task import Method
from dln_jax.types import Needs
from dln_jax.zoo.catalogue import CATALOGUE, Entry, Properties
from dln_jax.zoo.descriptions import describe_for


def make_rod(needs: Needs, *, dtype=jnp.float64) -> Model:
    """L = ½ inertia qd² + weight cos q, with two parameters."""

    def energies(parameters):
        inertia, weight = parameters
        return LagrangianSystem(lambda q, qd: 0.5 * inertia * qd[0] ** 2 + weight * jnp.cos(q[0]))

    return Model(lambda key: jnp.ones(2, dtype), energies)


def fit(task, options, folder, mesh):
    """Inertia and weight from tau = inertia qdd + weight sin q, by least squares in closed form."""
    train = task.sets.train
    columns = np.column_stack([train.qdd[:, 0], np.sin(train.q[:, 0])])
    parameters = np.linalg.lstsq(columns, train.tau[:, 0])[0]
    return task, training_of(task, options.heaviness * jnp.asarray(parameters), 0.0, 0.0)


def plan(options, kind, recorded, objective):
    return describe_for(kind, recorded.sets.train, recorded.needs, precision="f64"), None


@dataclass(frozen=True)
class RodOptions:
    """Options of its fit."""

    heaviness: float = 1.0
    """Factor of the parameters."""


@dataclass(frozen=True)
class Arguments(Options):
    """Arguments of a command that trains it."""

    VARIANTS: ClassVar = VARIANTS
    model: str = "rod"


@pytest.fixture
def rod(monkeypatch):
    monkeypatch.setitem(FITS, "rod", Fit(lambda: Method(plan, fit), (RodOptions,)))
    monkeypatch.setitem(CATALOGUE, "rod", Entry(make_rod, Properties(linear=True), MappingProxyType({})))


def test_a_method_and_an_entry_are_all_that_a_new_model_needs(rod, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene = pendulum()
    schema.save("log.npz", generators.uniform(scene, samples=80))
    options = {"data": tmp_path / "log.npz", "out": tmp_path / "run", "figures": False, "low_latency": False}
    run(arguments_of(Arguments, heaviness=1.0, **options), "train_delan")
    metrics = json_of(tmp_path / "run" / "metrics.json")
    assert metrics["torque_mse"] < 1e-20 and metrics["verdict"] == 0
    plant = dln_jax.load(tmp_path / "run").dynamics
    q, qd, qdd = jnp.array([0.7]), jnp.array([-1.0]), jnp.array([2.0])
    with jax.enable_x64(True):
        np.testing.assert_allclose(
            plant.inverse_dynamics(q, qd, qdd), dln_jax.dynamics(scene.energies).inverse_dynamics(q, qd, qdd), rtol=1e-9
        )


@pytest.mark.parametrize("command", [train_delan, train_hnn], ids=["train_delan", "train_hnn"])
def test_every_model_of_a_command_has_a_method(command):
    hint = command.Arguments.__annotations__["model"]
    names = {name for literal in _literals(hint) for name in literal}
    assert names - {AUTO} <= set(FITS) - {AUTO} <= set(CATALOGUE) and names


def _literals(hint):
    inner = getattr(hint, "__args__", ())
    if inner and all(isinstance(name, str) for name in inner):
        return [inner]
    return [literal for part in inner for literal in _literals(part)]
