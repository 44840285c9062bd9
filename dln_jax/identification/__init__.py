"""Identification: estimate the parameters of a robot and say which of them its data determine.

`identify(model, known, data)` does both for a model that is linear in its parameters, such as `models.make_rigid_tree`.
"""

from dln_jax.identification.base import BaseParameters, base_parameters, determinacy, null_directions
from dln_jax.identification.consistent import ConsistentFit, fit_consistent, is_consistent, nearest_body
from dln_jax.identification.equations import Columns, Equations, columns_of, compressed, flat, regressor_of
from dln_jax.identification.identify import Identification, identify, parameters_of, random_states
from dln_jax.identification.weighted import (
    ResidualStatistics,
    WeightedFit,
    fit_robust,
    fit_weighted,
    residual_statistics,
)

__all__ = [
    "BaseParameters",
    "Columns",
    "ConsistentFit",
    "Equations",
    "Identification",
    "ResidualStatistics",
    "WeightedFit",
    "base_parameters",
    "columns_of",
    "compressed",
    "determinacy",
    "fit_consistent",
    "fit_robust",
    "fit_weighted",
    "flat",
    "identify",
    "is_consistent",
    "nearest_body",
    "null_directions",
    "parameters_of",
    "random_states",
    "regressor_of",
    "residual_statistics",
]
