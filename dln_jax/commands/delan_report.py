"""Measure the structured DeLaN against the published implementation: errors, training time, one-step latency.

It trains with the published protocol (64x64 tanh, batch 512, 20,000 steps, float32, test letters e, q, v) on
--data, by default the embedded letters, and checks the generic mechanics against the closed form of the arm.
Prints a table and writes report.json with one number per row. It is one split: `arm_table` measures others.
"""

from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.command_line.arguments import Unstated
from dln_jax.command_line.progress import progress
from dln_jax.data import schema
from dln_jax.data.splits import Split, split
from dln_jax.datasets.default_data import CHARACTERS_TEST, default_data
from dln_jax.files import run_folder
from dln_jax.learning.dynamics_fit import Settings, train
from dln_jax.mechanics.equations import dynamics
from dln_jax.metrics.errors import errors, predictions
from dln_jax.metrics.latency import one_step
from dln_jax.scenes.scene import closed_form_forward_dynamics, closed_form_inverse_dynamics
from dln_jax.scenes.two_link_arm import two_link_arm
from dln_jax.studies.report import Row, conditions, write_report
from dln_jax.studies.report_table import print_report
from dln_jax.types import require_positive
from dln_jax.zoo.kinds import build
from dln_jax.zoo.load import compiled

# Published results (mean of 10 seeds), and the published implementation measured on two cores.
PUBLISHED = {
    "torque_mse": 2.2e-5,
    "inertial_mse": 3.2e-5,
    "coriolis_mse": 1.4e-5,
    "gravity_mse": 2.0e-5,
    "train_seconds": 108.0,
    "one_step_p50_us": 111.0,
}
BOUNDS = {
    "torque_mse": 3e-6,
    "inertial_mse": 1e-5,
    "coriolis_mse": 1e-5,
    "gravity_mse": 1e-5,
    "train_seconds": 45.0,
    "one_step_p50_us": 111.0 / 3,
}
UNITS = {"power_mse": "W^2", "forward_mse": "1/s^4"}


@dataclass(frozen=True)
class Arguments:
    """What to measure on."""

    data: Unstated[Path] = None
    """Trajectories of the two-link arm in the npz schema (default: the embedded letters)."""
    test: str = ",".join(CHARACTERS_TEST)
    """Labels of the test trajectories, comma separated."""
    seeds: int = 1
    """How many seeds to train, from 0 upwards; each also draws its own validation letters."""
    steps: int = 20_000
    """Optimiser steps."""
    out: Unstated[Path] = None
    """Folder for report.json (default: runs/delan_report-1, -2, ...)."""


def main(given: Arguments) -> None:
    """Measures, prints and writes."""
    require_positive(seeds=given.seeds, steps=given.steps)
    data = default_data(two_link_arm()) if given.data is None else schema.load(given.data)
    data = data._replace(needs=two_link_arm().needs)
    sets = [split(data, test=given.test.split(","), seed=seed) for seed in range(given.seeds)]
    with run_folder(given.out, "delan_report") as folder:
        measure_into(folder, given, sets)


def measure_into(folder: Path, given: Arguments, sets: list[Split]) -> None:
    """Measures every seed, and writes and prints the table."""
    name = "embedded-letters" if given.data is None else given.data.stem
    rows = textbook_rows(two_link_arm())
    for seed, its_sets in enumerate(sets):
        rows += delan_rows(f"structured-delan/{name}/seed-{seed}", its_sets, Settings(steps=given.steps, seed=seed))
    facts = conditions(dtype="float32; textbook float64", seeds=list(range(given.seeds)), call_path="default jit")
    write_report(folder / "report.json", rows, facts)
    print_report(rows, facts)
    print(f"report: {folder / 'report.json'}")


def delan_rows(case: str, sets: Split, settings: Settings) -> list[Row]:
    """Trains one seed and measures everything that the published table has."""
    description = {
        "kind": "structured-delan",
        "needs": two_link_arm().needs._asdict(),
        "width": 64,
        "depth": 2,
        "activation": "tanh",
        "precision": settings.precision,
    }
    model = build(description)
    with progress(settings.steps) as show:
        training = train(
            model,
            sets,
            settings,
            report=lambda at: show(min(int(at.step), settings.steps), f"{case}  loss {at.loss:.2e}"),
        )
    energies = model.energies(training.parameters)
    system = compiled(dynamics(energies), jnp.float32)
    states = list(zip(*(jnp.asarray(a[:400], jnp.float32) for a in sets.test[1:4]), strict=True))
    latency = one_step(system.inverse_dynamics, states)
    numbers = {
        **errors(predictions(energies, sets.test, jnp.float32), sets.test),
        "train_seconds": training.train_seconds,
        "compile_seconds": training.compile_seconds,
        "one_step_p50_us": latency.p50_us,
        "one_step_p99_us": latency.p99_us,
    }
    return [Row(case, key, value, unit(key), PUBLISHED.get(key), BOUNDS.get(key)) for key, value in numbers.items()]


def textbook_rows(scene, *, states: int = 1000) -> list[Row]:
    """Largest error of the generic Lagrangian mechanics in float64, relative to the largest value."""
    q, qd, qdd, tau = np.random.default_rng(0).uniform(-np.pi, np.pi, (4, states, scene.needs.degrees_of_freedom))
    generic = dynamics(scene.energies)
    pairs = {
        "inverse": (generic.inverse_dynamics, closed_form_inverse_dynamics, qdd),
        "forward": (generic.forward_dynamics, closed_form_forward_dynamics, tau),
    }
    rows = []
    for name, (derived, closed_form, last) in pairs.items():
        got = jax.jit(jax.vmap(derived))(q, qd, last)
        expected = jax.jit(jax.vmap(lambda *state, closed_form=closed_form: closed_form(scene, *state)))(q, qd, last)
        error = float(jnp.max(jnp.abs(got - expected)) / jnp.max(jnp.abs(expected)))
        rows.append(Row(f"textbook/{scene.name}", f"{name}_relative_error", error, "1", 0.0, 1e-12))
    return rows


def unit(quantity: str) -> str:
    """SI unit of a quantity, by its name."""
    if quantity.endswith("_mse"):
        return UNITS.get(quantity, "N^2 m^2")
    return "s" if quantity.endswith("_seconds") else "us"
