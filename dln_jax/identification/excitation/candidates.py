"""Candidate motions: check them against the limits, measure their information, and draw random ones.

A motion is checked at ten times as many samples as it is designed at, and keeps a margin for the times between.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.identification.excitation.fourier import FourierMotion, harmonic_functions, rest_basis
from dln_jax.identification.excitation.limits import worst
from dln_jax.identification.excitation.task import Task
from dln_jax.types import InputError, require_positive, require_seed

FINER = 10
"""Refinement of the time grid for checking motions."""
MARGIN = 1e-3
"""Margin kept to every limit at the checked samples (relative; m for clearances) to cover the times between them."""
DRAWS = 50
"""Drawing stops after this number of failed draws per motion found."""
SMALLEST, BISECTIONS = 0.05, 8
"""Smallest amplitude of a shrunk motion, relative to the original, and the number of bisection steps."""


class Design(NamedTuple):
    """A motion within the limits, and how informative it is."""

    motion: FourierMotion
    information: Float[np.ndarray, "B B"]
    """A, averaged over samples."""
    condition: float
    """Condition of the regressor of base parameters with columns of unit length."""
    log_determinant: float
    """log det A."""
    slack: float
    """Smallest relative distance to a limit."""
    nearest: str
    """Limit with the smallest distance."""


def functions_at(task: Task, t: Float[np.ndarray, " N"]) -> list[np.ndarray]:
    """Harmonic functions and their first two derivatives at all times, [N, 2 H] each."""
    return [*map(np.asarray, jax.vmap(lambda t: harmonic_functions(task.harmonics, task.period, t))(t))]


def grid(task: Task, finer: int = 1) -> Float[np.ndarray, " N"]:
    """Times of one period, equally spaced and without its end: the design grid, refined by a factor `finer`."""
    return task.period * np.arange(finer * task.steps) / (finer * task.steps)


def states(functions: list[np.ndarray], offset: Any, coefficients: Any) -> tuple[Any, Any, Any]:
    """q, qd, qdd [N, d]."""
    q, qd, qdd = (values @ jnp.asarray(coefficients).T for values in functions)
    return offset + q, qd, qdd


def furthest(task: Task, motion: FourierMotion) -> tuple[float, str]:
    """The largest excess on the fine grid, and the name of that limit."""
    motions = states(functions_at(task, grid(task, FINER)), motion.offset, motion.coefficients)
    parts = zip(*(np.split(np.asarray(array), FINER) for array in motions), strict=True)
    return max(worst(task.samples(*part)[2]) for part in parts)


def shrink_to_limits(task: Task, motion: FourierMotion) -> tuple[Design | None, str]:
    """Shrinks a motion towards its mean posture until it keeps the limits; `None` if even the smallest breaks them.

    The second result is the limit broken at the smallest amplitude, as text.
    """

    def shrunk(amplitude: float) -> FourierMotion:
        return motion._replace(coefficients=amplitude * np.asarray(motion.coefficients))

    beyond, _ = furthest(task, motion)
    if beyond <= -MARGIN:
        return assess(task, motion), ""
    beyond, kind = furthest(task, shrunk(SMALLEST))
    if beyond > -MARGIN:
        return None, f"{kind} by {100 * beyond:.2g} %" if kind != "clearance" else f"clearance by {beyond:.2g} m"
    amplitude, broken = SMALLEST, 1.0
    for _ in range(BISECTIONS):
        middle = (amplitude + broken) / 2
        if furthest(task, shrunk(middle))[0] <= -MARGIN:
            amplitude = middle
        else:
            broken = middle
    return assess(task, shrunk(amplitude)), ""


def weighted(task: Task, Phi: Any) -> Any:
    """Regressor of the base parameters with rows divided by the joint's noise: [N, d, P] -> [N, d, B]."""
    return Phi[..., task.columns] / task.noise[:, None]


def assess(task: Task, motion: FourierMotion) -> Design:
    """Computes information, condition and slack of a motion."""
    at = states(functions_at(task, grid(task)), motion.offset, motion.coefficients)
    W = weighted(task, np.asarray(task.samples(*at)[0])).reshape(-1, task.columns.size)
    lengths = np.linalg.norm(W, axis=0)
    sizes = np.linalg.svd(W / np.where(lengths > 0, lengths, 1.0), compute_uv=False)
    with np.errstate(divide="ignore"):
        logarithm = 2 * np.sum(np.log(sizes)) + 2 * np.sum(np.log(lengths)) - len(sizes) * np.log(task.steps)
    beyond, kind = furthest(task, motion)
    condition = float(sizes[0] / sizes[-1]) if sizes[-1] > 0 else np.inf
    return Design(motion, W.T @ W / task.steps, condition, float(logarithm), -beyond, kind)


def random_designs(task: Task, count: int, *, seed: int = 0) -> list[Design]:
    """Draws random motions, with every joint scaled to its limits and the whole motion to those of force and clearance.

    Raises:
        InputError: too few draws are within the limits (50 failures per motion found); the message names the limit.
    """
    require_positive(count=count)
    require_seed(seed)
    random, limits, basis = np.random.default_rng(seed), task.limits, rest_basis(task.harmonics)
    functions = functions_at(task, grid(task, FINER))
    lower, upper = limits.position.T
    # Dividing by the order gives all harmonics the same velocity.
    spectrum = 1 / np.tile(np.arange(1, task.harmonics + 1), 2)
    designs, failed = [], 0
    while len(designs) < count:
        coefficients = random.normal(size=(len(lower), 2 * task.harmonics)) * spectrum @ basis @ basis.T
        q, qd, qdd = (values @ coefficients.T for values in functions)
        sizes = [np.ptp(q, axis=0) / (upper - lower)]
        sizes += [abs(rate).max(axis=0) / bound for rate, bound in ((qd, limits.velocity), (qdd, limits.acceleration))]
        scale = (1 - 2 * MARGIN) / np.max(sizes, axis=0)
        free = (upper - lower) - scale * np.ptp(q, axis=0)
        offset = lower - scale * q.min(axis=0) + free * random.uniform(0.1, 0.9, len(lower))
        motion = FourierMotion(offset, scale[:, None] * coefficients, task.period)
        design, broken = shrink_to_limits(task, motion)
        if design is not None:
            designs.append(design)
        elif (failed := failed + 1) >= DRAWS * max(1, len(designs)):
            raise InputError(
                f"{failed} random motions broke the limits even when small, the last of {broken}; widen it"
            )
    return designs
