"""Which parameters forces depend on: alone, in combination, or not at all.

Forces depend on P parameters through fewer combinations, the base parameters (Gautier and Khalil 1990; numerically
Gautier 1991). With columns in an order of preference, those that are no combination of earlier ones stay, Phi_1, and
the others are Phi_2 = Phi_1 K, so that Phi theta = Phi_1 (theta_1 + K theta_2). Bodies nearer to the ground come first,
and of a body what is usually kept; its mass, h_z and I_yy are what is usually regrouped.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.identification.columns import Columns

Determinacy = Literal["alone", "in combination", "not at all"]
PREFERRED = ("I_zz", "h_x", "h_y", "I_xx", "I_xy", "I_xz", "I_yz", "I_yy", "h_z", "m")
"""Of the ten of a body, those first that stay."""
TOLERANCE = 1e-8
"""Relative length of what of a column is no combination of others, below which it is one; random states leave digits
enough between rounding and what exists."""
NEGLIGIBLE = 1e-12
"""Columns shorter than this times the longest are zeros that terms leave which cancel."""
SHOWN = 1e-7
"""Coefficients smaller than this, relative to the largest of their combination, are rounding and not in words."""


class BaseParameters(NamedTuple):
    """B combinations of P parameters."""

    combinations: Float[np.ndarray, "B P"]
    """beta = combinations theta; 1 in the column that a combination is called by."""
    independent: tuple[int, ...]
    """That column of each."""
    words: tuple[str, ...]
    """As "I_xx_3 + 0.3 m_4"."""


def base_parameters(
    A: Float[np.ndarray, "N P"], columns: Columns, *, tolerance: float = TOLERANCE, negligible: float = NEGLIGIBLE
) -> BaseParameters:
    """The base parameters of equations in general states, by Gram-Schmidt with reorthogonalisation.

    Args:
        A: Phi of more states than there are parameters, or its triangle.
        columns: their names.
        tolerance: what is left of a column's length below which it is a combination of others.
        negligible: relative length of columns that are none.
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
    # In units of the columns' lengths, and back.
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
    """Columns by joint from the ground, a body's as `PREFERRED`, those that are no body's last."""

    def key(column: int) -> tuple[bool, int, int]:
        name, body = columns.names[column], columns.kinds[column] == "inertia"
        return (not body, columns.joints[column], PREFERRED.index(name.rpartition("_")[0]) if body else column)

    return sorted(range(len(columns.names)), key=key)


def in_words(combination: Float[np.ndarray, " P"], names: Sequence[str]) -> str:
    """A combination as a sum, the names with factor 1 first."""
    chosen = sorted(np.flatnonzero(combination).tolist(), key=lambda column: (combination[column] != 1.0, column))
    text = ""
    for column in chosen:
        factor = combination[column]
        size = "" if abs(abs(factor) - 1) < SHOWN else f"{abs(factor):.4g} "
        sign = ("-" if factor < 0 else "") if not text else (" - " if factor < 0 else " + ")
        text += f"{sign}{size}{names[column]}"
    return text


def determinacy(unseen: Float[np.ndarray, "K P"], *, tolerance: float = 1e-6) -> tuple[Determinacy, ...]:
    """Of each parameter, from orthonormal directions that change no force.

    Args:
        unseen: in units in which all columns have one length; an unseen column has a direction of its own.
        tolerance: share of a direction that counts as none.
    """
    shares = np.linalg.norm(unseen, axis=0)
    return tuple("alone" if s < tolerance else "not at all" if s > 1 - tolerance else "in combination" for s in shares)


def null_directions(
    A: Float[np.ndarray, "N P"], *, tolerance: float = TOLERANCE, negligible: float = NEGLIGIBLE
) -> Float[np.ndarray, "K P"]:
    """Orthonormal directions of the parameters, in units of their columns' lengths, that equations do not show.

    Args:
        A: Phi, or its triangle.
        tolerance: relative to the largest singular value.
        negligible: relative length of columns that are none.
    """
    norms = np.linalg.norm(A, axis=0)
    seen = norms > negligible * norms.max(initial=0.0)
    scaled = np.where(seen, A, 0.0) / np.where(seen, norms, 1.0)
    _, sizes, right = np.linalg.svd(np.linalg.qr(scaled, mode="r"))
    rank = int(np.sum(sizes > tolerance * sizes.max(initial=0.0)))
    return right[rank:]
