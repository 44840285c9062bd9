"""How a search for a root or a minimum ended."""

from typing import NamedTuple

from jaxtyping import Array, Bool, Float, Int


class Info(NamedTuple):
    """How an iteration ended."""

    residual: Float[Array, ""]
    """Largest |f| at the last point judged: of the equations, or of the gradient in units of its scale."""
    iterations: Int[Array, ""]
    """Newton steps taken."""
    converged: Bool[Array, ""]
    """Whether the residual is within the tolerance or at the level of rounding; false for values that are not
    finite."""
    definite: Bool[Array, ""] | None = None
    """Of a minimum: whether the Hessian there, as it is, is positive definite, so that it is no saddle. Costs a
    factorisation, which is left out of the program where this is not used."""
