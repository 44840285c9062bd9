"""What a trained model of a Hamiltonian task comes to: its errors and times, and what figures show of it."""

import functools
from collections.abc import Mapping
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
        numbers["train_loss"] = field_errors(model, parameters, problem.train)["loss"]
        tested = field_errors(model, parameters, problem.test)
        numbers |= {"test_loss": tested["loss"], "clean_field_mse": tested["clean_field_mse"]}
    numbers["train_seconds"] = sum(fit.train_seconds for fit in trained.fits.values())
    numbers["compile_seconds"] = sum(fit.compile_seconds for fit in trained.fits.values())
    numbers["parameters"] = float(sum(leaf.size for leaf in jax.tree.leaves(parameters)))
    return numbers, Seen(predicted[0], functools.partial(field_rates, model, parameters))


def figure_of(problem: Problem, seen: Mapping[str, Seen]) -> Figure:
    """The figure of a task: the first motion as each model has it, and its energy, or that of the first coordinate."""
    motions = {TRUTH: problem.truth[0], **{name: each.motions for name, each in seen.items()}}
    fields = {name: each.rates for name, each in seen.items()}
    if problem.energy is not None:
        heights = {name: energies(problem.energy, each) for name, each in motions.items()}
        return motion_figure(motions, heights, fields=fields, units=units_of(problem))
    angles = {name: each.q[:, :, 0] for name, each in motions.items()}
    return motion_figure(motions, angles, fields=fields, quantity="q1", units=units_of(problem))


UNITS = {"revolute": ("rad", "kg m²/s"), "prismatic": ("m", "kg m/s")}


def units_of(problem: Problem) -> tuple[str, str, str]:
    """Of the first coordinate, of its momentum, and of what the task's figure shows over time."""
    of_q, of_p = UNITS[problem.needs.joints[0]]
    return (of_q, of_p, "J") if problem.energy is not None else (of_q, f"{of_q}/s", of_q)
