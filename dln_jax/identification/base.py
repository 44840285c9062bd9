"""Base parameters: which parameters are identifiable alone, which only in combination, and which not at all.

Forces depend on P parameters through fewer combinations, the base parameters (Gautier and Khalil 1990; numerically
Gautier 1991). The columns are visited in an order of preference. A column that is linearly independent of those before
it is kept, in Phi_1; the others are Phi_2 = Phi_1 K, so that Phi theta = Phi_1 (theta_1 + K theta_2). Bodies nearer to
the ground come first. Within a body, mass, h_z and I_yy come last: these are the parameters usually regrouped.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.identification.equations import Columns

Determinacy = Literal["alone", "in combination", "not at all"]
PREFERRED = ("I_zz", "h_x", "h_y", "I_xx", "I_xy", "I_xz", "I_yz", "I_yy", "h_z", "m")
"""The ten parameters of a body, in their stored order."""
DEPENDENT = 1e-8
"""Columns whose residual after projection on the others is shorter than this fraction of their length count as linearly
dependent; so do singular values below this fraction of the largest. For random states this lies well between rounding
errors and true residuals."""
NEGLIGIBLE = 1e-12
"""Columns shorter than this fraction of the longest are zero up to rounding: their terms cancel."""
SHARE = 1e-6
"""A parameter counts as identifiable alone if its share in the undetermined directions is below this number."""
SHOWN = 1e-7
"""Coefficients below this fraction of the largest in their combination are rounding errors and set to zero."""


class BaseParameters(NamedTuple):
    """B identifiable combinations of P parameters."""

    combinations: Float[np.ndarray, "B P"]
    """beta = combinations theta; every row has a 1 in its independent column."""
    independent: tuple[int, ...]
    """Independent column of every combination."""
    words: tuple[str, ...]
    """Combinations as text, such as "I_xx_3 + 0.3 m_4"."""


def unit_columns(A: Float[np.ndarray, "N P"]) -> tuple[Float[np.ndarray, "N P"], Float[np.ndarray, " P"]]:
    """Scales columns to unit length; returns them and their lengths, with zeros for `NEGLIGIBLE` columns."""
    lengths = np.linalg.norm(A, axis=0)
    lengths = np.where(lengths > NEGLIGIBLE * lengths.max(initial=0.0), lengths, 0.0)
    return np.where(lengths > 0, A, 0.0) / np.where(lengths > 0, lengths, 1.0), lengths


def base_parameters(A: Float[np.ndarray, "N P"], columns: Columns) -> BaseParameters:
    """Finds the base parameters by Gram-Schmidt with reorthogonalisation.

    Args:
        A: Phi in generic states, more of them than parameters, or its triangular factor.
        columns: names, kinds and joints of the columns.
    """
    scaled, lengths = unit_columns(A)
    basis = np.zeros((A.shape[0], 0))
    independent: list[int] = []
    for column in _order(columns):
        remainder = scaled[:, column]
        for _ in range(2):
            remainder = remainder - basis @ (basis.T @ remainder)
        length = np.linalg.norm(remainder)
        if length > DEPENDENT:
            basis = np.column_stack([basis, remainder / length])
            independent.append(column)
    independent.sort()
    # Solve with columns of unit length, then scale back.
    factors = np.linalg.lstsq(scaled[:, independent], scaled, rcond=None)[0]
    combinations = factors * lengths / lengths[independent][:, None]
    combinations[abs(factors) < SHOWN * abs(factors).max(axis=1, initial=0.0)[:, None]] = 0.0
    combinations[:, independent] = np.eye(len(independent))
    words = tuple(in_words(row, columns.names) for row in combinations)
    return BaseParameters(combinations, tuple(independent), words)


def _order(columns: Columns) -> list[int]:
    """Columns of bodies by joint from the ground, within a body as in `PREFERRED`; all other columns last."""

    def key(column: int) -> tuple[bool, int, int]:
        name, body = columns.names[column], columns.kinds[column] == "inertia"
        return (not body, columns.joints[column], PREFERRED.index(name.rpartition("_")[0]) if body else column)

    return sorted(range(len(columns.names)), key=key)


def in_words(combination: Float[np.ndarray, " P"], names: Sequence[str]) -> str:
    """Writes a combination as a sum, starting with the names that have factor 1."""
    chosen = sorted(np.flatnonzero(combination).tolist(), key=lambda column: (combination[column] != 1.0, column))
    text = ""
    for column in chosen:
        factor = combination[column]
        size = "" if abs(abs(factor) - 1) < SHOWN else f"{abs(factor):.4g} "
        sign = ("-" if factor < 0 else "") if not text else (" - " if factor < 0 else " + ")
        text += f"{sign}{size}{names[column]}"
    return text


def determinacy(unseen: Float[np.ndarray, "K P"]) -> tuple[Determinacy, ...]:
    """Classifies every parameter as identifiable alone, in combination or not at all.

    Args:
        unseen: orthonormal directions that change no force, for columns of unit length; zero columns have one each.
    """
    shares = np.linalg.norm(unseen, axis=0)
    return tuple("alone" if s < SHARE else "not at all" if s > 1 - SHARE else "in combination" for s in shares)


def null_directions(A: Float[np.ndarray, "N P"]) -> Float[np.ndarray, "K P"]:
    """Orthonormal directions of the parameters that the equations do not determine, for columns scaled to unit length.

    Args:
        A: Phi, or its triangular factor.
    """
    _, sizes, right = np.linalg.svd(np.linalg.qr(unit_columns(A)[0], mode="r"))
    return right[int(np.sum(sizes > DEPENDENT * sizes.max(initial=0.0))) :]
