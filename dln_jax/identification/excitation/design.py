"""Optimal excitation: gradient-based design of informative motions within a robot's limits.

The unknowns are the joints' Fourier coefficients. The criterion is a function of A (`excitation.task`):

    information    log det A: the product of all parameters' errors, independent of units (D-optimal)
    condition      largest over smallest singular value of the regressor with columns of unit length

Each limit at each sample is an inequality constraint of an augmented Lagrangian. Both criteria have many local minima,
so several random starts are optimised. The check of a motion uses ten times as many samples as its design, with a
margin for the times between. A motion that exceeds a limit is designed again with a larger margin, or shrunk.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.data.schema import Trajectories
from dln_jax.identification.excitation.limits import worst
from dln_jax.identification.excitation.task import (
    FourierMotion,
    Task,
    harmonic_functions,
    require_sampling,
    rest_basis,
    sample,
    states,
)
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.model import Model, Parameters
from dln_jax.solvers.augmented_lagrangian import make_minimiser
from dln_jax.types import InputError, Needs, Scalar, require_positive, require_seed

SHARPNESS = 4
"""Exponent of the power means that approximate the largest and the smallest eigenvalue."""
FIRST_MARGIN, TIGHTENINGS = 0.01, 3
"""Initial relative margin to the limits for excursions between samples, and the largest number of designs; a design
that exceeds the limits increases the margin."""
FINER = 10
"""Refinement of the time grid for checking motions."""
MARGIN = 1e-3
"""Margin to each limit at the checked samples (relative; m for clearances), for the times between them."""
DRAWS = 50
"""Largest number of failed draws per successful motion."""
SMALLEST, BISECTIONS = 0.05, 8
"""Smallest amplitude of a shrunk motion relative to the original, and the number of bisection steps."""
Criterion = Callable[[Array], Array]
"""A [B, B] -> scalar to minimise."""


class Design(NamedTuple):
    """A motion within the limits, with its information."""

    motion: FourierMotion
    information: Float[np.ndarray, "B B"]
    """A, averaged over samples."""
    slack: float
    """Smallest relative distance to a limit."""
    nearest: str
    """Limit with the smallest distance."""

    @property
    def condition(self) -> float:
        """Condition number of the base regressor with columns of unit length."""
        return together([self])[0]

    @property
    def log_determinant(self) -> float:
        """log det A."""
        return together([self])[1]


def functions_at(task: Task, finer: int = 1) -> list[np.ndarray]:
    """Returns harmonic functions and their first two derivatives, [N, 2 H] each, on the refined design grid."""
    t = task.period * np.arange(finer * task.steps) / (finer * task.steps)
    return [*map(np.asarray, harmonic_functions(task.harmonics, task.period, t))]


def furthest(task: Task, motion: FourierMotion) -> tuple[float, str]:
    """Returns the largest excess on the fine grid, and the name of that limit."""
    motions = states(functions_at(task, FINER), motion.offset, motion.coefficients)
    parts = zip(*(np.split(np.asarray(array), FINER) for array in motions), strict=True)
    return max(worst(task.samples(*part)[2]) for part in parts)


def shrink_to_limits(task: Task, motion: FourierMotion) -> tuple[Design | None, str]:
    """Shrinks a motion towards its mean posture until it keeps the limits; `None` if the smallest one breaks them.

    The second result is the broken limit at the smallest amplitude, as text.
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


def average_information(task: Task, Phi: Any) -> Any:
    """Returns A for the regressors [N, d, P] of a motion on the design grid."""
    W = (Phi[..., task.columns] / task.noise[:, None]).reshape(-1, task.columns.size)
    return W.T @ W / task.steps


def assess(task: Task, motion: FourierMotion) -> Design:
    """Computes information and slack of a motion."""
    at = states(functions_at(task), motion.offset, motion.coefficients)
    beyond, kind = furthest(task, motion)
    return Design(motion, average_information(task, np.asarray(task.samples(*at)[0])), -beyond, kind)


def random_designs(task: Task, count: int, *, seed: int = 0) -> list[Design]:
    """Draws random motions, scaled per joint to its limits, and as a whole to the limits of force and clearance.

    Raises:
        InputError: too few draws are within the limits (50 failures per success); the message names the limit.
    """
    require_positive(count=count)
    require_seed(seed)
    random, limits, basis = np.random.default_rng(seed), task.limits, rest_basis(task.harmonics)
    functions = functions_at(task, FINER)
    lower, upper = limits.position.T
    # Dividing by the order gives all harmonics the same velocity.
    spectrum = 1 / np.tile(np.arange(1, task.harmonics + 1), 2)
    designs, failed = [], 0
    while len(designs) < count:
        coefficients = random.normal(size=(len(lower), 2 * task.harmonics)) * spectrum @ basis @ basis.T
        q, qd, qdd = (values @ coefficients.T for values in functions)
        extent = np.ptp(q, axis=0)
        rates = abs(qd).max(axis=0) / limits.velocity, abs(qdd).max(axis=0) / limits.acceleration
        scale = (1 - 2 * MARGIN) / np.max([extent / (upper - lower), *rates], axis=0)
        free = (upper - lower) - scale * extent
        offset = lower - scale * q.min(axis=0) + free * random.uniform(0.1, 0.9, len(lower))
        motion = FourierMotion(offset, scale[:, None] * coefficients, task.period)
        design, broken = shrink_to_limits(task, motion)
        if design is not None:
            designs.append(design)
        elif (failed := failed + 1) >= DRAWS * max(1, len(designs)):
            raise InputError(
                f"{failed} random motions broke the limits even when small, the last one {broken}; widen that limit"
            )
    return designs


Designer = Callable[..., Design]
"""(starts, earlier designs that add information) -> best design within the limits."""


def _scaled(A: Float[Array, "B B"]) -> tuple[Float[Array, "B B"], Float[Array, " B"]]:
    """Returns A scaled to a unit diagonal, and the square roots of its diagonal."""
    lengths = jnp.sqrt(jnp.diagonal(A))
    return A / lengths[:, None] / lengths, lengths


def information(A: Float[Array, "B B"]) -> Scalar:
    """Returns -log det A / 2 B, the mean logarithm of the standard errors along uncorrelated axes."""
    scaled, lengths = _scaled(A)
    return -(0.5 * jnp.linalg.slogdet(scaled)[1] + jnp.sum(jnp.log(lengths))) / A.shape[0]


def condition(A: Float[Array, "B B"]) -> Scalar:
    """Returns the log condition of the regressor with unit-length columns; smooth means replace extreme eigenvalues."""
    sizes = jnp.log(jnp.maximum(jnp.linalg.eigvalsh(_scaled(A)[0]), jnp.finfo(A.dtype).eps))
    largest, smallest = (jax.nn.logsumexp(sign * SHARPNESS * sizes) / SHARPNESS for sign in (1, -1))
    return 0.5 * (largest + smallest)


CRITERIA: dict[str, Criterion] = {"information": information, "condition": condition}


def make_designer(task: Task, criterion: Criterion, *, rounds: int = 8, iterations: int = 60) -> Designer:
    """Makes a function that optimises starts and returns the best design including the starts; it compiles once.

    Args:
        task: model and constraints, from `make_task`.
        criterion: function of the information, such as one of `CRITERIA`.
        rounds: largest number of rounds of the augmented Lagrangian.
        iterations: L-BFGS iterations per round.
    """
    functions, basis = functions_at(task), rest_basis(task.harmonics)
    middle, half = task.limits.position.mean(axis=1), np.diff(task.limits.position, axis=1)[:, 0] / 2

    def series(x: Any) -> tuple[Any, Any]:
        """Converts dimensionless unknowns to offset and coefficients."""
        unknowns = x.reshape(len(half), -1)
        return middle + half * unknowns[:, 0], half[:, None] * (unknowns[:, 1:] @ basis.T)

    def problem(x: Array, known: Array, margin: Array) -> tuple[Array, Array]:
        motion = states(functions, *series(x))
        Phi, _, beyond = jax.vmap(task.observe)(*motion)
        A = known + average_information(task, Phi)
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

    def best(starts: Sequence[Design], before: Sequence[Design] = ()) -> Design:
        known = sum((design.information for design in before), np.zeros_like(starts[0].information))

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
    """Designs motions for identification, each complementing the previous ones, and a separate one for validation.

    Args:
        task: model and constraints, from `make_task`.
        drawn: starts, for example from `random_designs`, divided equally among the motions.
        trajectories: number of motions for identification.
        criterion: a name in `CRITERIA`.
        say: takes the number of finished motions and the last result as text.

    Raises:
        InputError: an unknown criterion, no trajectories, or fewer starts than motions.
    """
    if criterion not in CRITERIA:
        raise InputError(f"criterion is '{criterion}'; choose from {', '.join(CRITERIA)}")
    require_positive(trajectories=trajectories)
    starts = len(drawn) // (trajectories + 1)
    if not starts:
        raise InputError(
            f"{len(drawn)} starts are too few for {trajectories + 1} motions; expected at least one per motion"
        )
    best = make_designer(task, CRITERIA[criterion])
    designs: list[Design] = []
    for place in range(trajectories + 1):
        own = drawn[place * starts : (place + 1) * starts]
        designs.append(best(own, designs if place < trajectories else ()))
        say(place + 1, f"condition {designs[-1].condition:.3g}")
    return designs[:-1], designs[-1]


def together(designs: Sequence[Design]) -> tuple[float, float]:
    """Returns condition number and log det A of several motions of equal length together."""
    scaled, lengths = map(np.asarray, _scaled(jnp.asarray(np.mean([design.information for design in designs], axis=0))))
    sizes = np.linalg.eigvalsh(np.nan_to_num(scaled))
    if not sizes[0] > 0:
        return np.inf, -np.inf
    return float(np.sqrt(sizes[-1] / sizes[0])), float(np.sum(np.log(sizes)) + 2 * np.sum(np.log(lengths)))


def error_ratio(designs: Sequence[Design], others: Sequence[Design]) -> float:
    """Returns the geometric mean over parameters of the standard errors from `designs` relative to as many `others`."""
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
    count, first = len(designs), designs[0].motion
    require_sampling(period=first.period, harmonics=first.harmonics, rate=rate)
    t = np.linspace(0.0, first.period, round(first.period * rate) + 1)
    q, qd, qdd = map(np.concatenate, zip(*(sample(design.motion, t) for design in designs), strict=True))
    tau = np.asarray(jax.jit(jax.vmap(dynamics(model.energies(parameters)).inverse_dynamics))(q, qd, qdd))
    index = np.repeat(np.arange(count), len(t))
    return Trajectories(np.tile(t, count), q, qd, qdd, tau, index, label=np.array(labels), needs=needs)
