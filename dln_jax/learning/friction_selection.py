"""Chooses optional torque terms of a rigid tree: coupled motors, friction that depends on load or on temperature.

Any extra term lowers the error on its own training data, whether or not the plant has it. A term is therefore kept only
if it lowers the error in cross-validation over trajectories (or blocks of time) by more than `MARGIN` standard errors.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import BLOCKS, every, in_blocks
from dln_jax.learning.friction_terms import Log, Terms, equations_of, link_signs, log_of, solve_terms
from dln_jax.learning.select import segments, significantly_better
from dln_jax.mechanics.trees.description import Tree

FOLDS = 4
MOST_SAMPLES = 2_000
MARGIN = 2.0
"""A term must lower the error by this number of standard errors; about one log in forty does so by chance."""


class TriedTerm(NamedTuple):
    """A term and the errors with and without it."""

    name: str
    without: float
    """Mean squared error in cross-validation, summed over joints, in units of each torque's variance."""
    within: float
    """The same, with the term."""
    kept: bool


def choose_terms(
    tree: Tree, data: Trajectories, terms: Terms, candidates: Sequence[tuple[str, Terms]]
) -> tuple[Terms, list[TriedTerm]]:
    """Tries candidates one after another and keeps those that lower the cross-validation error significantly.

    Args:
        candidates: name of each candidate, and the terms that it adds.

    Raises:
        InputError: as for `learning.friction.fit_friction`.
    """
    if not candidates:
        return terms, []
    if len(np.unique(data.trajectory)) < FOLDS:
        data = in_blocks(data, BLOCKS)
    data = every(data, -(-len(data.t) // MOST_SAMPLES))
    segment, tried = segments(data), []
    errors = cross_validated(tree, data, terms, segment)
    for name, candidate in candidates:
        wider = joined(terms, candidate)
        trial = cross_validated(tree, data, wider, segment)
        kept = significantly_better(trial, errors, margin=MARGIN)
        tried.append(TriedTerm(name, float(errors.mean()), float(trial.mean()), kept))
        if kept:
            terms, errors = wider, trial
    return terms, tried


def joined(terms: Terms, addition: Terms) -> Terms:
    """Returns the union of two sets of terms, with the initial shapes of the first."""
    laws, learned, coupled = (
        tuple(dict.fromkeys((*getattr(terms, name), *getattr(addition, name))))
        for name in ("laws", "learned", "coupled")
    )
    return terms._replace(laws=laws, learned=learned, coupled=coupled)


def cross_validated(
    tree: Tree, data: Trajectories, terms: Terms, segment: np.ndarray
) -> Float[np.ndarray, " segments"]:
    """Mean squared error of every segment, from fits to the folds without it."""
    present = np.unique(data.trajectory)
    folds = [np.isin(data.trajectory, present[fold::FOLDS]) for fold in range(FOLDS)]
    fewest = min(int(np.sum(~held)) for held in folds)
    with jax.enable_x64(True):
        log, equations = log_of(tree, data, terms), equations_of(terms)
        evaluate = jax.jit(equations)
        squares = np.zeros(len(data.t))
        for held in folds:
            rest = np.flatnonzero(~held)
            # The same number of samples in every fold, so that one compiled program serves all.
            rows = rest[np.linspace(0, len(rest) - 1, fewest).round().astype(int)]
            solution = solve_terms(terms, log.of(rows), equations)
            whole: Log = log._replace(signs=link_signs(terms, log, solution))
            A, b = (np.asarray(part) for part in evaluate(solution.nonlinear, whole))
            squares[held] = np.sum((A @ solution.linear - b).reshape(len(data.t), -1) ** 2, axis=1)[held]
    return np.bincount(segment, squares) / np.bincount(segment)
