"""Optimal excitation: gradient-based design of informative motions within a robot's limits.

The unknowns are the joints' Fourier coefficients. The criterion is a function of A (`excitation.task`):

    information    log det A: the product of all parameters' errors, independent of units (D-optimal)
    condition      largest over smallest singular value of the regressor with columns of unit length

Every limit at every sample is an inequality constraint of an augmented Lagrangian. Both criteria have many local
minima, so several random starts are optimised. The result keeps the limits at ten times as many samples; a motion that
does not is designed again with a larger margin or shrunk.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.data.schema import Trajectories
from dln_jax.identification.excitation.candidates import (
    MARGIN,
    Design,
    functions_at,
    furthest,
    grid,
    shrink_to_limits,
    states,
    weighted,
)
from dln_jax.identification.excitation.fourier import FourierMotion, require_sampling, rest_basis, sample
from dln_jax.identification.excitation.task import Task
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.model import Model, Parameters
from dln_jax.solvers.augmented_lagrangian import make_minimiser
from dln_jax.types import InputError, Needs, Scalar, require_positive

SHARPNESS = 4
"""Exponent of the power means that approximate the largest and the smallest eigenvalue."""
FIRST_MARGIN, TIGHTENINGS = 0.01, 3
"""Initial margin to the limits, relative to them, for excursions between samples; and the number of designs, with a
larger margin after each that exceeds the limits."""
Criterion = Callable[[Array], Array]
"""A [B, B] -> scalar to minimise."""
Designer = Callable[..., Design]
"""(starts, information already available [B, B] or `None`) -> the best design within the limits."""


def _scaled(A: Float[Array, "B B"]) -> tuple[Float[Array, "B B"], Float[Array, " B"]]:
    """A scaled to a unit diagonal, and the square roots of its diagonal."""
    lengths = jnp.sqrt(jnp.diagonal(A))
    return A / lengths[:, None] / lengths, lengths


def information(A: Float[Array, "B B"]) -> Scalar:
    """-log det A / 2 B: the mean logarithm of the standard errors along uncorrelated axes."""
    scaled, lengths = _scaled(A)
    return -(0.5 * jnp.linalg.slogdet(scaled)[1] + jnp.sum(jnp.log(lengths))) / A.shape[0]


def condition(A: Float[Array, "B B"]) -> Scalar:
    """Logarithm of the regressor's condition with unit-length columns; smooth means replace extreme eigenvalues."""
    sizes = jnp.log(jnp.maximum(jnp.linalg.eigvalsh(_scaled(A)[0]), jnp.finfo(A.dtype).eps))
    largest, smallest = (jax.nn.logsumexp(sign * SHARPNESS * sizes) / SHARPNESS for sign in (1, -1))
    return 0.5 * (largest + smallest)


CRITERIA: dict[str, Criterion] = {"information": information, "condition": condition}


def make_designer(task: Task, criterion: Criterion, *, rounds: int = 8, iterations: int = 60) -> Designer:
    """Makes a function that optimises starts and returns the best design, the starts included; it compiles once.

    Args:
        criterion: function of the information, such as one of `CRITERIA`.
        rounds: upper limit of rounds of the augmented Lagrangian.
        iterations: L-BFGS iterations per round.
    """
    functions, basis = functions_at(task, grid(task)), rest_basis(task.harmonics)
    middle, half = task.limits.position.mean(axis=1), np.diff(task.limits.position, axis=1)[:, 0] / 2

    def series(x: Any) -> tuple[Any, Any]:
        """Offset and coefficients of dimensionless unknowns."""
        unknowns = x.reshape(len(half), -1)
        return middle + half * unknowns[:, 0], half[:, None] * (unknowns[:, 1:] @ basis.T)

    def problem(x: Array, known: Array, margin: Array) -> tuple[Array, Array]:
        motion = states(functions, *series(x))
        Phi, _, beyond = jax.vmap(task.observe)(*motion)
        W = weighted(task, Phi).reshape(-1, task.columns.size)
        A = known + W.T @ W / task.steps
        return criterion(A), jnp.concatenate([limit.ravel() + margin for limit in jax.tree.leaves(beyond)])

    minimise = make_minimiser(problem, rounds=rounds, iterations=iterations)

    def optimised(start: Design, known: np.ndarray) -> Design | None:
        motion, margin = start.motion, FIRST_MARGIN
        posture = (np.asarray(motion.offset) - middle) / half
        x = np.column_stack([posture, np.asarray(motion.coefficients) / half[:, None] @ basis]).ravel()
        for _ in range(TIGHTENINGS):
            x = minimise(x, known, margin).x
            offset, coefficients = series(x)
            motion = FourierMotion(np.asarray(offset), np.asarray(coefficients), task.period)
            beyond = furthest(task, motion)[0]
            if beyond <= -MARGIN:
                break
            margin += beyond + 2 * MARGIN
        return shrink_to_limits(task, motion)[0]

    def best(starts: Sequence[Design], known: Any = None) -> Design:
        if not starts:
            raise InputError("there are no starts; expected at least one design")
        known = np.zeros_like(starts[0].information) if known is None else np.asarray(known)

        def worth(design: Design) -> float:
            value = float(criterion(jnp.asarray(known + design.information)))
            return value if np.isfinite(value) else np.inf

        designs = [design for start in starts if (design := optimised(start, known)) is not None]
        return min([*designs, *starts], key=worth)

    return best


def design_set(
    task: Task,
    drawn: Sequence[Design],
    *,
    trajectories: int = 3,
    criterion: str = "information",
    say: Callable[[int, str], None] = lambda done, text: None,
) -> tuple[list[Design], Design]:
    """Designs motions for identification, each complementing those before it, and a separate one for validation.

    Args:
        drawn: starts such as `random_designs`, divided equally among the motions.
        criterion: a name in `CRITERIA`.
        say: called with the number of finished motions and the last result as text.

    Raises:
        InputError: an unknown criterion, no trajectories, or fewer starts than motions.
    """
    if criterion not in CRITERIA:
        raise InputError(f"criterion is '{criterion}'; choose from {', '.join(CRITERIA)}")
    require_positive(trajectories=trajectories)
    starts = len(drawn) // (trajectories + 1)
    if not starts:
        raise InputError(f"{len(drawn)} starts are fewer than the {trajectories + 1} motions; expected one for each")
    best = make_designer(task, CRITERIA[criterion])
    designs: list[Design] = []
    for place in range(trajectories + 1):
        own = drawn[place * starts : (place + 1) * starts]
        known = sum(design.information for design in designs) if 0 < place < trajectories else None
        designs.append(best(own, known))
        say(place + 1, f"condition {designs[-1].condition:.3g}")
    return designs[:-1], designs[-1]


def together(designs: Sequence[Design]) -> tuple[float, float]:
    """Condition and log det A of several motions of equal length taken together."""
    scaled, lengths = map(np.asarray, _scaled(jnp.asarray(np.mean([design.information for design in designs], axis=0))))
    sizes = np.linalg.eigvalsh(scaled)
    if not sizes[0] > 0:
        return np.inf, -np.inf
    return float(np.sqrt(sizes[-1] / sizes[0])), float(np.sum(np.log(sizes)) + 2 * np.sum(np.log(lengths)))


def error_ratio(designs: Sequence[Design], others: Sequence[Design]) -> float:
    """Geometric mean over parameters of the standard errors from `designs` over those from `others`, equally many."""
    count = designs[0].information.shape[0]
    return float(np.exp((together(others)[1] - together(designs)[1]) / (2 * count)))


def as_trajectories(
    designs: Sequence[Design], labels: Sequence[str], model: Model, parameters: Parameters, *, rate: float, needs: Needs
) -> Trajectories:
    """Samples motions from rest to rest at equal steps, with the torques of the nominal model.

    Args:
        rate: samples per second.
        needs: `Needs` of the dataset; its torques include friction if the model does.

    Raises:
        InputError: the rate is too low for the harmonics.
    """
    motions = [design.motion for design in designs]
    period = motions[0].period
    require_sampling(period=period, harmonics=motions[0].harmonics, rate=rate)
    t = np.linspace(0.0, period, round(period * rate) + 1)
    q, qd, qdd = map(np.concatenate, zip(*(sample(motion, t) for motion in motions), strict=True))
    force = jax.jit(jax.vmap(dynamics(model.energies(parameters)).inverse_dynamics))
    index = np.repeat(np.arange(len(motions)), len(t))
    states = {"q": q, "qd": qd, "qdd": qdd, "tau": np.asarray(force(q, qd, qdd))}
    return Trajectories(t=np.tile(t, len(motions)), trajectory=index, label=np.array(labels), needs=needs, **states)
