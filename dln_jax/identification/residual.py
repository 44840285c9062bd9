"""A small residual network on top of an identified tree, no larger than held-out motions justify.

The parameters of the tree are frozen. The candidates grow from no network at all. One replaces another only if its
error on validation motions is lower by more than the standard error of the difference. That error is computed over
segments of time assumed to be independent, since neighbouring samples are not.
"""

from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from dln_jax.data.arrays import spread
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import Split
from dln_jax.data.splits import select as trajectories
from dln_jax.learning import dynamics
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import GaussNewton
from dln_jax.learning.engine.problem import arrays_of
from dln_jax.learning.objectives import SCALED_TORQUE, residuals, squared_torque_errors, torque_scale
from dln_jax.learning.select import mean_of_segments, select
from dln_jax.models.model import Model, Parameters
from dln_jax.models.residual import ResidualParameters, frozen, make_residual, make_with_residual
from dln_jax.types import InputError, Needs, ResidualTerm

Candidate = tuple[tuple[ResidualTerm, ...], int]
"""Terms and width of a network."""
CANDIDATES: tuple[Candidate, ...] = (
    (("dissipation",), 4),
    (("potential", "dissipation"), 4),
    (("potential", "dissipation"), 8),
    (("potential", "dissipation", "inertia"), 8),
    (("potential", "dissipation"), 16),
)
Selected = tuple[Model, Parameters, dict[str, Any]]


def inner_split(train: Trajectories) -> tuple[Trajectories, Trajectories]:
    """Training data without every fourth trajectory or block, and those, to choose the size of a network by."""
    present = np.unique(train.trajectory)
    if len(present) < 2:
        raise InputError("a part to choose by takes two trajectories or blocks to fit; record more motions")
    return trajectories(train, np.setdiff1d(present, present[1::4])), trajectories(train, present[1::4])


def fit_residual(
    rigid: Model,
    parameters: Parameters,
    needs: Needs,
    train: Trajectories,
    validation: Trajectories,
    *,
    candidates: tuple[Candidate, ...] = CANDIDATES,
    iterations: int = 40,
) -> Selected:
    """Fits residual networks to the torques unexplained by an identified tree, and selects the smallest sufficient one.

    Returns the sum of both, its `ResidualParameters` and the keywords of `make_residual`; or the tree's own model and
    parameters and no keywords, if no network was selected.

    Args:
        rigid: such as `make_rigid_tree`.
        parameters: identified parameters, which stay fixed.
        train: data that the tree was identified from.
        validation: other motions, used for selection; judge the result on yet others.
        candidates: networks in order of size; every one has to improve on those before it, and the first on none.
        iterations: upper limit of Gauss-Newton iterations; the parameters with the lowest validation error are kept.

    Raises:
        InputError: the torques do not vary.
    """
    with jax.enable_x64(True):
        scale = torque_scale(train)
        batch = arrays_of(train, SCALED_TORQUE.keys)
        unexplained = jax.jit(lambda: residuals(SCALED_TORQUE, rigid.energies(parameters), batch))()
        magnitudes = {"torque_scale": unexplained, "rate_scale": train.qd, "acceleration_scale": train.qdd}
        sizes = {
            name: tuple(float(f"{size:.3g}") if size > 0 else 1.0 for size in spread(name, np.asarray(values)))
            for name, values in magnitudes.items()
        }

        def attempt(candidate: Candidate | None) -> tuple[Selected, Float[np.ndarray, " segments"]]:
            model, whole, settings = rigid, parameters, {}
            if candidate is not None:
                terms, width = candidate
                settings = {"terms": terms, "width": width, **sizes}
                model = make_with_residual(rigid, make_residual(needs, **settings))
                own = dynamics.problem(frozen(model, parameters), Split(train, validation, validation), SCALED_TORQUE)
                whole = ResidualParameters(parameters, fit(own, GaussNewton(steps=iterations)).parameters)
            squares = squared_torque_errors(model, whole, validation, scale)
            return (model, whole, settings), mean_of_segments(validation, np.sum(squares, axis=1))

        return select((None, *candidates), attempt, patience=2)[0].outcome
