"""A small residual network on top of an identified tree, as large as held-out motions justify.

The parameters of the tree are fixed. The first candidate is no network, and later ones grow. A candidate replaces the
previous one only if it lowers the error on validation motions by more than the standard error of the difference. The
standard error is computed over segments of time, since neighbouring samples are correlated.
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
    """Holds out every fourth training trajectory or block, for choosing the size of a network."""
    present = np.unique(train.trajectory)
    if len(present) < 2:
        raise InputError("choosing a network needs at least two trajectories or blocks to fit; record more motions")
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
    """Fits residual networks to the torques that an identified tree does not explain, and selects the smallest one.

    Returns the sum of tree and network, its `ResidualParameters` and the keywords of `make_residual`. If no network
    improves the tree, returns the tree's model and parameters without keywords.

    Args:
        rigid: the tree, for example from `make_rigid_tree`.
        parameters: identified parameters, which stay fixed.
        needs: needs of the tree.
        train: training data of the tree.
        validation: other motions for the selection; evaluate the result on further ones.
        candidates: networks in order of size; each must improve on the previous ones, and the first on no network.
        iterations: largest number of Gauss-Newton iterations; the parameters with the lowest validation error are kept.

    Raises:
        InputError: the torques are constant.
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
