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

from dln_jax.identification.columns import Columns

Determinacy = Literal["alone", "in combination", "not at all"]
PREFERRED = ("I_zz", "h_x", "h_y", "I_xx", "I_xy", "I_xz", "I_yz", "I_yy", "h_z", "m")
"""The ten parameters of a body, in the order in which they are kept."""
TOLERANCE = 1e-8
"""Columns whose residual after projection on the others is shorter than this fraction of their length count as linearly
dependent. For random states this lies well between rounding errors and true residuals."""
NEGLIGIBLE = 1e-12
"""Columns shorter than this fraction of the longest are zero up to rounding: their terms cancel."""
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


def base_parameters(
    A: Float[np.ndarray, "N P"], columns: Columns, *, tolerance: float = TOLERANCE, negligible: float = NEGLIGIBLE
) -> BaseParameters:
    """Finds the base parameters by Gram-Schmidt with reorthogonalisation.

    Args:
        A: Phi in generic states, more of them than parameters, or its triangular factor.
        columns: names, kinds and joints of the columns.
        tolerance: residual relative to a column's length below which the column counts as linearly dependent.
        negligible: columns shorter than this fraction of the longest count as zero.
    """
    norms = np.linalg.norm(A, axis=0)
    seen = norms > negligible * norms.max(initial=0.0)
    scaled = A / np.where(seen, norms, 1.0)
    basis = np.zeros((A.shape[0], 0))
    independent: list[int] = []
    for column in _order(columns):
        if not seen[column]:
            continue
        left = scaled[:, column]
        for _ in range(2):
            left = left - basis @ (basis.T @ left)
        length = np.linalg.norm(left)
        if length > tolerance:
            basis = np.column_stack([basis, left / length])
            independent.append(column)
    # Solve with columns of unit length, then scale back.
    factors = np.linalg.lstsq(scaled[:, independent], scaled * seen, rcond=None)[0]
    combinations = factors * np.where(seen, norms, 1.0) / norms[independent][:, None]
    sizes = abs(factors).max(axis=1, initial=0.0)[:, None]
    combinations[abs(factors) < SHOWN * sizes] = 0.0
    for row, column in enumerate(independent):
        combinations[row, independent] = 0.0
        combinations[row, column] = 1.0
    order = np.argsort(independent)
    combinations, independent = combinations[order], [independent[place] for place in order]
    words = [in_words(row, columns.names) for row in combinations]
    return BaseParameters(combinations, tuple(independent), tuple(words))


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


def determinacy(unseen: Float[np.ndarray, "K P"], *, tolerance: float = 1e-6) -> tuple[Determinacy, ...]:
    """Classifies every parameter as identifiable alone, in combination or not at all.

    Args:
        unseen: orthonormal directions that change no force, for columns scaled to unit length; a zero column has a
            direction of its own.
        tolerance: a parameter whose share in these directions is below it counts as identifiable alone.
    """
    shares = np.linalg.norm(unseen, axis=0)
    return tuple("alone" if s < tolerance else "not at all" if s > 1 - tolerance else "in combination" for s in shares)


def null_directions(
    A: Float[np.ndarray, "N P"], *, tolerance: float = TOLERANCE, negligible: float = NEGLIGIBLE
) -> Float[np.ndarray, "K P"]:
    """Orthonormal directions of the parameters that the equations do not determine, for columns scaled to unit length.

    Args:
        A: Phi, or its triangular factor.
        tolerance: singular values below this fraction of the largest count as zero.
        negligible: columns shorter than this fraction of the longest count as zero.
    """
    norms = np.linalg.norm(A, axis=0)
    seen = norms > negligible * norms.max(initial=0.0)
    scaled = np.where(seen, A, 0.0) / np.where(seen, norms, 1.0)
    _, sizes, right = np.linalg.svd(np.linalg.qr(scaled, mode="r"))
    rank = int(np.sum(sizes > tolerance * sizes.max(initial=0.0)))
    return right[rank:]
