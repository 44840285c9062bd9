"""What a trained model of a Hamiltonian task comes to: its errors and times, and what figures show of it."""

from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import jax
from matplotlib.figure import Figure

from dln_jax.figures.phase_space import Field, motion_figure
from dln_jax.figures.style import TRUTH
from dln_jax.metrics.phase_space import Motions, energies, field_errors, field_rates, motion_errors, predict
from dln_jax.studies.hamiltonian.tasks import Problem
from dln_jax.studies.hamiltonian.training import Trained
from dln_jax.zoo.descriptions import build


class Seen(NamedTuple):
    """What a figure shows of a model."""

    motions: Motions
    """The first entry of the problem's, as predicted."""
    rates: Field


def measured_once(problem: Problem, trained: Trained) -> tuple[dict[str, float], Seen]:
    """Errors and times of one run, and what it predicts."""
    model, parameters = build(trained.description), trained.result.parameters
    predicted = [predict(model, parameters, true.q[:, 0], true.p[:, 0], true.t) for true in problem.truth]
    numbers = motion_errors(predicted, problem.truth, problem.energy, published_energy=problem.published_energy)
    if problem.train is not None and problem.test is not None:
        fitted, tested = (field_errors(model, parameters, part) for part in (problem.train, problem.test))
        numbers["train_loss"], numbers["test_loss"] = fitted["loss"], tested["loss"]
        numbers["clean_field_mse"] = tested["clean_field_mse"]
    for name in ("train_seconds", "compile_seconds"):
        numbers[name] = sum(getattr(fit, name) for fit in trained.fits.values())
    numbers["parameters"] = float(sum(leaf.size for leaf in jax.tree.leaves(parameters)))
    return numbers, Seen(predicted[0], partial(field_rates, model, parameters))


def figure_of(problem: Problem, seen: Mapping[str, Seen]) -> Figure:
    """The figure of a task: the first motion as each model has it, and its energy, or that of the first coordinate."""
    motions = {TRUTH: problem.truth[0], **{name: each.motions for name, each in seen.items()}}
    fields = {name: each.rates for name, each in seen.items()}
    H = problem.energy
    heights = {name: each.q[:, :, 0] if H is None else energies(H, each) for name, each in motions.items()}
    quantity = "q1" if H is None else "true energy"
    return motion_figure(motions, heights, fields=fields, quantity=quantity, units=units_of(problem))


def units_of(problem: Problem) -> tuple[str, str, str]:
    """Of the first coordinate, of its momentum, and of what the task's figure shows over time."""
    of_q, of_p = {"revolute": ("rad", "kg m²/s"), "prismatic": ("m", "kg m/s")}[problem.needs.joints[0]]
    return (of_q, of_p, "J") if problem.energy is not None else (of_q, f"{of_q}/s", of_q)
