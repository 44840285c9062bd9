"""Fits models to q, qd and torques by the equations of motion in weak form, without accelerations.

With the momentum p = M(q) qd, tau = dp/dt + s(q, qd), where s = tau(q, qd, 0) - dM/dt qd holds gravity, friction and
the rest of the Coriolis forces. Multiplied by a window w(t) that is zero at both ends, and integrated by parts:

    - integral w' p dt + integral w s dt = integral w tau dt

(modulating functions, Shinbrot 1957; for robots the filtered forms of Slotine and Li 1987.) Accelerations, whose noise
grows with the square of the frequency, do not appear. Both sides pass through the same low-pass, so that dry friction
is not distorted, and the result hardly depends on the cut-off of q. Torques that are held between samples are no harder
to fit than smooth ones. The windows are sin⁴ (pi t / W); plain sums over their samples are as accurate as the motion is
smooth.

`fit_momentum` fits any model that is linear in its parameters: one equation per joint and window. A recording of q and
commanded torques is fitted in four steps:

1. The delay of the torques, unless known, is the one that gives an identified model the smallest residual.
2. q is smoothed (`data.encoders`), which also gives qd; torques are not filtered, and held between samples.
3. The identified model is the trigonometric one. Its residuals in the joints' equations are the scales of a network's
   errors, so that joints with and without a motor both count.
4. The network is a structured DeLaN with the same friction laws, fitted to the same windows by Gauss-Newton.
"""

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jaxtyping import Float, Int

from dln_jax.data.encoders.sampling import EVEN, delay_held, held_at_equal_steps
from dln_jax.data.encoders.smoothing import smooth
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import segments, select
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import GaussNewton
from dln_jax.learning.engine.problem import ProgressReport, arrays_of, selected_by, silent
from dln_jax.learning.linear import unravelled
from dln_jax.learning.objectives import torque_scale
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.model import Model, Parameters
from dln_jax.precision import quick_compilation
from dln_jax.solvers import least_squares
from dln_jax.types import FrictionLaw, InputError, Needs, Vector, require_positive
from dln_jax.zoo.descriptions import Description, build, describe

WINDOW = 0.16
"""Length of a window in s: about two periods of the highest frequency that a low-pass at 12 Hz passes."""
FEWEST = 8
"""Smallest number of steps of a window."""
OVERLAP = 5
"""Number of windows that start within the length of one; more would be nearly redundant."""
CHUNK = 4096
"""Samples whose columns are in memory at a time."""
ROUNDS = 10
"""Largest number of reweighted fits; three to five are usual."""
SETTLED = 0.01
"""Relative change of the errors' covariance that ends them."""
SURE = 4.0
"""An estimated delay is rounded if it is within this number of standard errors of a whole number."""
LAWS: tuple[FrictionLaw, ...] = ("viscous", "coulomb")
"""Friction laws of the models; other friction of the plant, near rest, is not modelled."""
MOST_DELAY = 4
DEGREE = 2
"""Degree of the identified mass matrix in every angle: enough for rigid bodies. Displacements along a level rail have
no effect."""
CHECKED = 500
"""Number of the recording's positions for checking the mass matrix."""
WIDTH, DEPTH = 8, 2
"""Size of the network."""
STEPS = 40
FRICTION_START = 0.02
"""Initial friction coefficients of a network, relative to the deviation of the torques."""
FLOOR = 0.05
"""Lower bound on the diagonal of a network's Cholesky factor, relative to its typical size."""


class WeakFit(NamedTuple):
    """Identified parameters, and how well the data determine them; otherwise as `learning.linear.LinearFit`."""

    parameters: Any
    """Parameters of the model, in its dtype."""
    parameter_count: int
    rank: int
    condition: float
    errors: Float[np.ndarray, "W d"]
    """Error of every window's mean torques, N m or N."""


class MomentumWindows(NamedTuple):
    """W windows of S steps."""

    q: Float[np.ndarray, "W S+1 d"]
    qd: Float[np.ndarray, "W S+1 d"]
    impulse: Float[np.ndarray, "W d"]
    """Integral of w tau dt, N m or N: a mean torque if the integral of w is 1."""
    dt: float
    trajectory: Int[np.ndarray, " W"]


class FittedPlant(NamedTuple):
    """Description and parameters of a plant's model, as `zoo.run.save` stores them."""

    description: Description
    parameters: Any

    @property
    def dynamics(self) -> Dynamics:
        """Dynamics of the model."""
        return _dynamics(build(self.description), self.parameters)


class PreparedRecording(NamedTuple):
    """A recording that is ready for fits."""

    train: Trajectories
    """Episodes to fit, with rates and acting torques."""
    validation: Trajectories
    delay: float
    """Delay of the torques in samples."""
    cutoff: float
    """Cut-off frequency of the filter, Hz."""


def fit_momentum(
    model: Model,
    data: Trajectories,
    *,
    window: float = WINDOW,
    noise: Float[np.ndarray, " d"] | None = None,
    reweighted: bool = False,
    **tolerances: Any,
) -> WeakFit:
    """Fits the momenta of windows by least squares, in float64; qdd is not read.

    Args:
        model: linear in its parameters, such as `models.make_rigid_tree` and `models.make_trigonometric`.
        data: at equal time steps, with smooth velocities and measured torques, such as from `data.encoders.smooth`.
        window: length in s, at least `FEWEST` steps.
        noise: deviations of the torques' noise that divide the equations (default: those of the torques themselves).
        reweighted: weight the equations by the covariance of their own errors until it settles (iterated generalised
            least squares, Zellner 1962). Noise of encoders enters the equations of all joints through the mass matrix.
            Without its correlations, equations without a motor, which zero parameters satisfy, pull those of a plant
            with weak motors towards zero.
        tolerances: ridge, rank_tolerance and negligible of `solvers.least_squares.solve`.

    Raises:
        InputError: unequal steps, no segment as long as a window, torques that do not vary, or settings out of range.
    """
    require_positive(window=window)
    d = data.degrees_of_freedom
    with jax.enable_x64(True):
        scale = np.asarray(torque_scale(data)) if noise is None else np.asarray(noise, float)
        if scale.shape != (d,) or not (scale > 0).all():
            raise InputError(f"noise is {scale}; expected a positive number for each of {d} joints")
        equations = list(_equations(_columns(model), data, scale, window))
    if not equations:
        raise _too_short(window)

    def solve(factor: np.ndarray | None) -> tuple[least_squares.LeastSquaresSolution, np.ndarray]:
        """Solution and errors [W, d] with equations divided by their deviations, or by a factor of a covariance."""

        def weigh(rows: np.ndarray, unit: np.ndarray) -> np.ndarray:
            return rows / unit[:, None] if factor is None else np.linalg.solve(factor, rows)

        chunks = ((weigh(A, unit).reshape(b.size, -1), weigh(b[..., None], unit).ravel()) for A, b, unit in equations)
        solution = least_squares.solve_chunks(chunks, **tolerances)
        return solution, np.concatenate([A @ solution.x - b for A, b, _ in equations])

    factor = None
    solution, errors = solve(factor)
    for _ in range(1, ROUNDS if reweighted else 1):
        covariance = errors.T @ errors / len(errors)
        if factor is not None:
            change = np.linalg.solve(factor, np.linalg.solve(factor, covariance).T) - np.eye(d)
            if np.abs(change).max() < SETTLED:
                break
        try:
            factor = np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError:
            break  # exact data leave no errors
        solution, errors = solve(factor)
    like = _shapes(model)
    parameters = jax.tree.map(
        lambda leaf, as_built: jnp.asarray(leaf, as_built.dtype), unravelled(solution.x, like), like
    )
    return WeakFit(parameters, solution.x.size, solution.rank, solution.condition, errors)


def momentum_and_rest(plant: Dynamics, q: Vector, qd: Vector) -> tuple[Vector, Vector]:
    """p = M qd and s = tau(q, qd, 0) - dM/dt qd of one state: tau = dp/dt + s."""
    p, change = jax.jvp(lambda place: plant.mass_matrix(place) @ qd, (q,), (qd,))
    return p, plant.inverse_dynamics(q, qd, jnp.zeros_like(qd)) - change


def window_weights(steps: int, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """w dt and w' dt [steps + 1] of a window of this number of steps, scaled so that the integral of w is 1."""
    phase = np.pi * np.arange(steps + 1) / steps
    w, slope = np.sin(phase) ** 4, 4 * np.pi / (steps * dt) * np.sin(phase) ** 3 * np.cos(phase)
    return w / w.sum(), slope / w.sum()


@functools.lru_cache(maxsize=4)
def _columns(model: Model) -> Callable[..., Array]:
    """(q, qd as [N, d]) -> derivatives [N, 2 d, P] of momentum and rest by the parameters, compiled."""
    zero, unravel = ravel_pytree(jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), _shapes(model)))

    def columns(q: Vector, qd: Vector) -> Array:
        def both(theta: Array) -> Array:
            return jnp.concatenate(momentum_and_rest(_dynamics(model, unravel(theta)), q, qd))

        values, pull_back = jax.vjp(both, zero)
        return jax.vmap(pull_back)(jnp.eye(values.shape[0], dtype=values.dtype))[0]

    return jax.jit(jax.vmap(columns), compiler_options=quick_compilation())


def _shapes(model: Model) -> Parameters:
    return jax.eval_shape(model.init, jax.random.key(0))


def _dynamics(model: Model, parameters: Parameters) -> Dynamics:
    return dynamics(model.energies(parameters))  # type: ignore[return-value]  # models of recordings have energies


def _too_short(window: float) -> InputError:
    return InputError(f"no segment of the data is as long as a window of {window:g} s; give a shorter one")


def _equations(
    program: Callable[..., Array], data: Trajectories, noise: Float[np.ndarray, " d"], window: float
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Columns [W, d, P], right-hand sides [W, d] and their deviations [d] of windows, one chunk after the other."""
    pieces = segments(data.t, data.trajectory)
    length, d = min(CHUNK, max(len(piece) for piece in pieces)), len(noise)
    for piece in pieces:
        if len(piece) <= FEWEST:
            continue
        steps_taken = np.diff(data.t[piece])
        dt = float(np.median(steps_taken))
        if np.abs(np.cumsum(steps_taken - dt)).max() > 10 * EVEN * dt * len(piece):
            raise InputError("steps in time are not equal, as windows take them; resample with data.encoders.smooth")
        steps = max(FEWEST, round(window / dt))
        w, slope = window_weights(steps, dt)
        unit = np.sqrt(w**2 @ np.broadcast_to(noise, (steps + 1, d)) ** 2)
        starts = np.arange(0, len(piece) - steps, max(1, steps // OVERLAP))
        advance = max(1, length - steps)
        for begin in range(0, len(piece) - steps, advance):
            mine = starts[(starts >= begin) & (starts < begin + advance)]
            if not len(mine):
                continue
            rows = piece[np.minimum(np.arange(begin, begin + max(length, steps + 1)), len(piece) - 1)]
            values, tau = np.asarray(program(data.q[rows], data.qd[rows])), data.tau[rows]
            parts = [slice(start - begin, start - begin + steps + 1) for start in mine]
            columns = [
                np.tensordot(w, values[part, d:], 1) - np.tensordot(slope, values[part, :d], 1) for part in parts
            ]
            yield np.stack(columns), np.stack([w @ tau[part] for part in parts]), unit


def cut_momentum_windows(data: Trajectories) -> MomentumWindows:
    """Cuts overlapping windows within gapless segments; `InputError` if no segment is long enough."""
    pieces = segments(data.t, data.trajectory)
    dt = float(np.median(np.concatenate([np.diff(data.t[piece]) for piece in pieces])))
    steps = max(FEWEST, round(WINDOW / dt))
    rows = [
        piece[first : first + steps + 1]
        for piece in pieces
        for first in range(0, len(piece) - steps, max(1, steps // OVERLAP))
    ]
    if not rows:
        raise _too_short(WINDOW)
    chosen = np.stack(rows)
    w, _ = window_weights(steps, dt)
    impulse = np.einsum("s,wsd->wd", w, data.tau[chosen])
    return MomentumWindows(data.q[chosen], data.qd[chosen], impulse, dt, np.asarray(data.trajectory[chosen[:, 0]]))


def momentum_errors(plant: Dynamics, q: Array, qd: Array, impulse: Array, *, dt: float) -> Array:
    """Residual of one window's equations [d], in N m or N."""
    w, slope = map(jnp.asarray, window_weights(q.shape[0] - 1, dt))
    p, rest = jax.vmap(lambda q, qd: momentum_and_rest(plant, q, qd))(q, qd)
    return w @ rest - slope @ p - impulse


def _residuals(plant: Dynamics, windows: MomentumWindows) -> Float[Array, "W d"]:
    return jax.vmap(lambda *window: momentum_errors(plant, *window, dt=windows.dt))(*map(jnp.asarray, windows[:3]))


def deviations(plant: Dynamics, windows: MomentumWindows) -> Float[np.ndarray, " d"]:
    """Root mean square over windows of the residuals of the joints' equations, N m or N."""
    return np.sqrt(np.mean(np.asarray(jax.jit(lambda: _residuals(plant, windows))()) ** 2, axis=0))


def acceleration_misfit(plant: Dynamics, windows: MomentumWindows) -> Array:
    """Half the log determinant of the covariance of acceleration errors: residuals divided by M in a window's middle.

    It compares models of one plant. Residuals alone favour models with small parameters if a joint has no motor.
    """
    masses = jax.vmap(plant.mass_matrix)(jnp.asarray(windows.q[:, windows.q.shape[1] // 2]))
    errors = jnp.linalg.solve(masses, _residuals(plant, windows)[..., None])[..., 0]
    return jnp.linalg.slogdet(errors.T @ errors / len(errors))[1] / 2


def driven_torques(data: Trajectories, *, delay: float) -> Trajectories:
    """Returns the torques that act at the samples, from commanded torques that are delayed and held between samples.

    A torque held over a step contributes to both its ends: the torque at a sample is the mean of those held before and
    after it. The first torques of a trajectory, before the first command, are zero.

    Args:
        delay: delay of the commands in samples.

    Raises:
        InputError: a delay that is negative or not finite.
    """
    acting = np.zeros_like(data.tau)
    for index in np.unique(data.trajectory):
        rows = np.flatnonzero(data.trajectory == index)
        steps = delay_held(data.tau[rows], float(delay))
        acting[rows] = (np.concatenate([np.zeros_like(steps[:1]), steps[:-1]]) + steps) / 2
    return data._replace(tau=acting)


def delay_of_torques(model: Model, recording: Trajectories) -> float:
    """Estimates the delay of torques in samples: that with the smallest residuals of a model linear in its parameters.

    Commands of hardware may take effect between samples. The fitted equations' residuals r are linear in the torques:
    between the whole delays k and k + 1, up to `MOST_DELAY`,

        r = r_k - s D,    D = r_k - r_{k+1},    s = r_k . D / D . D

    The episodes' parts of r . D give the standard error of s. A delay within `SURE` standard errors of a whole number
    is rounded to it.

    Args:
        model: model that is linear in its parameters, such as `models.make_trigonometric`.
        recording: q and the commanded torques.

    Raises:
        InputError: as for `smooth` and `fit_momentum`.
    """
    smoothed = smooth(recording)
    unit = np.asarray(torque_scale(smoothed.data))

    def errors(delay: int) -> np.ndarray:
        late = smooth(driven_torques(recording, delay=delay), smoothed.cutoff).data
        return fit_momentum(model, late, noise=unit).errors / unit

    of_delays = [errors(whole) for whole in range(MOST_DELAY + 1)]
    episode = cut_momentum_windows(smoothed.data).trajectory
    candidates = []
    for whole, (earlier, later) in enumerate(itertools.pairwise(of_delays)):
        change = earlier - later
        total = float(np.sum(change**2)) or np.inf
        share = float(np.clip(np.sum(earlier * change) / total, 0.0, 1.0))
        left = earlier - share * change
        # Windows of one episode share their errors, so that each episode counts once.
        parts = [np.sum((left * change)[episode == one]) for one in np.unique(episode)]
        count = len(parts)
        error = np.sqrt(np.sum(np.square(parts)) * count / (count - 1)) / total if count > 1 else np.inf
        candidates.append((float(np.sum(left**2)), whole + share, error))
    _, delay, error = min(candidates)
    return float(round(delay)) if abs(delay - round(delay)) < SURE * error else delay


def prepare(
    recording: Trajectories, *, delay: float | None = None, chain: bool = False, cutoffs: Sequence[float] = (1.0,)
) -> PreparedRecording:
    """Computes rates and acting torques, and splits off the middle episode for validation.

    Args:
        recording: several episodes, with the needs of the plant.
        delay: delay of the torques in samples (default: estimated).
        chain: whether the plant is one for `identified_chain`.
        cutoffs: multiples of the cut-off that `smooth` chooses; of several, the one whose identified model predicts
            validation best (`acceleration_misfit`) is taken.

    Raises:
        InputError: a recording without needs or with only one episode.
    """
    present = np.unique(recording.trajectory)
    if recording.needs is None or len(present) < 2:
        raise InputError(
            f"the recording has {len(present)} episode(s){'' if recording.needs else ', and states no needs'}; "
            "expected at least 2, one of them to select by, and needs: record more, or cut it"
        )
    held_out = int(present[len(present) // 2])
    model, recording = build(_trigonometric(recording.needs, chain=chain)), held_at_equal_steps(recording)
    if delay is None:
        delay = delay_of_torques(model, recording)
    driven, rest = driven_torques(recording, delay=delay), np.setdiff1d(present, held_out)
    usual = smooth(driven)
    candidates = []
    for multiple in cutoffs:
        cutoff = multiple * usual.cutoff
        if multiple != 1 and not cutoff < usual.rate / 2:
            continue
        data = usual.data if multiple == 1 else smooth(driven, cutoff).data
        candidates.append(PreparedRecording(select(data, rest), select(data, [held_out]), float(delay), cutoff))

    def misfit(candidate: PreparedRecording) -> float:
        plant = _dynamics(model, fit_momentum(model, candidate.train).parameters)
        return float(jax.jit(lambda: acceleration_misfit(plant, cut_momentum_windows(candidate.validation)))())

    return candidates[0] if len(candidates) == 1 else min(candidates, key=misfit)


def _described(name: str, needs: Needs, **keywords: Any) -> Description:
    return describe(name, precision="f64", needs=needs._replace(joint_friction=LAWS, friction=False), **keywords)


def _trigonometric(needs: Needs, *, chain: bool) -> Description:
    """The mass matrix of a chain on a fixed base does not depend on the first coordinate."""
    turns = [int(joint == "revolute") for joint in needs.joints]
    degree = [DEGREE * turn for turn in turns]
    if chain:
        return _described("trigonometric", needs, degree=[0, *degree[1:]], potential_degree=turns)
    return _described("trigonometric", needs, degree=degree)


def _chains(needs: Needs) -> list[Description]:
    """Chains of rigid bodies: those whose links move in one plane, with all directions of the later axes, and any.

    Planar chains have far fewer coefficients. Slides that come first may point anywhere.
    """
    slides, hinges = (needs.joints.count(joint) for joint in ("prismatic", "revolute"))
    planar = []
    if hinges and "prismatic" not in needs.joints[slides:]:
        for signs in itertools.product((1, -1), repeat=hinges - 1):
            directions = [*[1] * (slides + 1), *signs]
            planar.append(_described("planar-chain", needs, directions=directions, symmetric=False, armature=True))
    return [*planar, _trigonometric(needs, chain=True)]


def identified(data: Trajectories, needs: Needs) -> FittedPlant:
    """Fits the trigonometric model with viscous and dry friction; errors as for `fit_momentum`.

    Args:
        data: recording with rates and acting torques.
    """
    description = _trigonometric(needs, chain=False)
    model = build(description)
    noise = np.sqrt(np.mean(fit_momentum(model, data).errors ** 2, axis=0))
    return FittedPlant(description, fit_momentum(model, data, noise=noise).parameters)


def identified_chain(prepared: PreparedRecording, needs: Needs) -> FittedPlant:
    """Fits a chain of rigid bodies on a fixed base, in relative coordinates, for which fewer motions suffice.

    Whether all links move in one plane, which axes point the other way, and how the equations are weighted is decided
    by the smallest `acceleration_misfit` in the validation episode. Models whose mass matrix is not positive definite
    at the recording's positions are left out.

    Raises:
        InputError: as for `fit_momentum`, or all models are left out.
    """
    held_out = cut_momentum_windows(prepared.validation)
    positions = np.concatenate([prepared.train.q, prepared.validation.q])
    positions = positions[:: max(len(positions) // CHECKED, 1)]
    best, least, share = None, np.inf, 0.0
    for description in _chains(needs):
        model = build(description)

        @jax.jit
        def judge(parameters: Parameters, model: Model = model) -> tuple[Array, Array]:
            plant = _dynamics(model, parameters)
            masses = jax.vmap(plant.mass_matrix)(jnp.asarray(positions))
            return jnp.linalg.eigvalsh(masses)[:, 0] > 0, acceleration_misfit(plant, held_out)

        for reweighted in (False, True):
            parameters = fit_momentum(model, prepared.train, reweighted=reweighted).parameters
            definite, misfit = map(np.asarray, judge(parameters))
            share = max(share, float(np.mean(definite)))
            if definite.all() and misfit < least:
                best, least = FittedPlant(description, parameters), float(misfit)
    if best is None:
        raise InputError(
            f"the identified mass matrix is positive definite at {share:.1%} of the recording's positions; expected "
            "all: record more or livelier motions of every joint"
        )
    return best


def learned(
    prepared: PreparedRecording, needs: Needs, *, seed: int = 0, report: ProgressReport = silent
) -> FittedPlant:
    """Trains a structured DeLaN with viscous and dry friction and keeps the parameters that are best in validation.

        r_w = [integral w (s - tau) dt - integral w' p dt] / unit_w

    Args:
        report: as for `learning.engine.fit`.

    Raises:
        InputError: as for `fit`.
    """
    windows, held_out = map(cut_momentum_windows, (prepared.train, prepared.validation))
    unit = jnp.asarray(deviations(identified(prepared.train, needs).dynamics, windows))
    tau, qdd = (getattr(prepared.train, name).std(axis=0) for name in ("tau", "qdd"))
    torque = float(np.max(tau))
    # The typical diagonal of L in M = L Lᵀ: the root of the geometric mean of torque over acceleration.
    size = float(np.exp(0.5 * np.mean(np.log(torque / qdd))))
    description = _described(
        "structured-delan", needs, diagonal_shift=_inverse_softplus(size), diagonal_floor=FLOOR * size,
        width=WIDTH, depth=DEPTH,
    )  # fmt: skip
    model = build(description)

    def typical(path: Any, leaf: Array) -> Array:
        """Scales the output layers of the initial networks, of order 1, to the plant."""
        name = jax.tree_util.keystr(path)
        if "coefficients" in name:
            return jnp.full_like(leaf, _inverse_softplus(FRICTION_START * torque))
        return leaf * (size if "cholesky" in name else torque) if f"linear_{DEPTH}" in name else leaf

    def residual(parameters: Parameters, *window: Array) -> Array:
        return momentum_errors(_dynamics(model, parameters), *window, dt=windows.dt) / unit

    start = jax.tree_util.tree_map_with_path(typical, model.init(jax.random.key(seed)))
    fitted, selecting = (arrays_of(part, ("q", "qd", "impulse")) for part in (windows, held_out))
    training = fit(selected_by(selecting, residual, start, fitted, seed), GaussNewton(steps=STEPS), report=report)
    return FittedPlant(description, training.parameters)


def _inverse_softplus(value: float) -> float:
    return float(np.log(np.expm1(value)))
