"""Chooses a swing-up's gains, catch region and regulator by simulated trials of a model, in one compiled program.

1. Numbers without units (`swing_up.RANGES`) are drawn; scales of the model turn them into gains and a regulator.
2. Every set is tried from near hanging, with the hardware's limits, resolution, noise and delay, and with motors that
   are stronger or weaker than in the model. The weight differs in the opposite direction, by the share `WEIGHT` of this
   error. Stronger motors also act later, by the share `LATE` of a sample.
3. The best sets are tried again with more errors, and from more starts. The margin of a set is the largest error up to
   which every trial succeeds. The candidates come up from most starts, have the largest margin and are not much slower
   than the fastest. The chosen set changes its controls least at the goal.
4. Plans with feedback (`planned`) are tried first, and chosen if they tolerate every error. Otherwise energy laws are
   tried too, with correct models in the first round, because few sets work. An energy law with a margin of `LEAST` or
   more is chosen, because it acts in any state, and a wrong model makes it slower but makes a plan fail. Otherwise the
   larger margin decides. For recovery from pushes by plans, repeated plans are tried instead.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control.closed_loop import Controller, Hardware, simulate, stateless
from dln_jax.control.observers import Estimator, by_differences
from dln_jax.control.plants.planned import (
    TrackedPlan,
    by_repeated_plans,
    follower,
    inner_ranges,
    plans_of,
    with_feedback,
)
from dln_jax.control.plants.plant import Layout, spread_of
from dln_jax.control.plants.runs import HELD, SPAN, TOLERANCE
from dln_jax.control.state_space import error
from dln_jax.control.swing_up import RANGES, SwingUpNumbers, Upright, law_of, swing_up_numbers, upright_of
from dln_jax.mechanics.dynamics import Dynamics, InverseForward
from dln_jax.types import InputError, require_positive, require_seed

ERRORS = (0.0, 0.1, -0.1, 0.2, -0.2, 0.3, -0.3, 0.4)
"""Relative errors of the motors' strength in the second round."""
WEIGHT = 0.125
"""Relative error of gravity, divided by that of the motors' strength."""
LATE = 0.5
"""Additional delay of stronger motors, in samples: the law may take longer to compute than the law during the
recording."""
SLOWER = 1.5
"""Largest time to the goal of the chosen set, relative to the fastest set with its margin."""
STARTS = 2
"""Smallest number of starts of a set with each error in the second round."""
FINALISTS = 8
ROUNDS = 4
"""Largest number of first rounds before `FINALISTS` sets have succeeded."""
WITHIN = 0.5
"""A trial must end within this share of the tolerance: real sticking friction causes larger limit cycles than the
smooth friction of the model."""
RESERVE = 0.95
"""A trial must stay within this share of the ranges and the largest rates: a plant starts more often, and from farther
away, than the trials."""
SECONDS, FALLS = 6.0, 26.0
"""Duration of a trial, s, and its minimum in units of 1 / lambda: the longest plan, with time to come to rest."""
LEAST = 0.1
"""Smallest margin of an energy law chosen instead of a plan."""
PLANS = 8
"""Largest number of plans tried with feedback."""
SETS_OF_REPEATED_PLANS = 2
"""Number of sets of repeated plans: few, because each trial plans again at every step of a plan."""


class SwingUp(NamedTuple):
    """A controller that swings the model up, and its safety margin."""

    controller: Controller
    """Controller of the measurements."""
    way: str
    """"energy", "plan" or "repeated plans"."""
    settings: SwingUpNumbers | TrackedPlan
    """Chosen settings, in SI units, with the regulator at the goal."""
    trials: int
    """Number of simulated trials."""
    worked: float
    """Share of sets in the first rounds that succeeded in all trials."""
    margin: float
    """Largest relative error of the motors' strength at which every trial of this set still succeeded."""
    seconds: float
    """Median time to the goal with the motors' strength of the model, s."""


def tune(
    model: Dynamics | InverseForward,
    layout: Layout,
    hardware: Hardware = Hardware(),  # noqa: B008
    *,
    estimator: Estimator | None = None,
    sets: int = 64,
    seconds: float | None = None,
    late: float = 0.0,
    seed: int = 0,
    recover: str = "swing-up",
) -> SwingUp:
    """Chooses all settings of a swing-up by trials.

    Args:
        model: known or learned, with friction if the plant has it.
        layout: layout of the plant: its motors, goal, limits and rate.
        hardware: noise, resolution and delay; the layout gives the limits.
        estimator: turns a controller of states into one of measurements, such as `by_filter`; by default differences.
        sets: number of sets in a first round.
        seconds: duration of a trial; the plant must come up and stay up for a second. By default 6 s, or longer for
            large plants, which fall slowly.
        late: additional delay of the motors beyond the hardware's whole samples, as a share of a sample.
        seed: seed of the sets, the starts and the noise.
        recover: "plans" for a law that plans again from the state after a push, or "swing-up".

    Raises:
        InputError: `swing_up` refuses the model, no set swings it up, or the recovery is unknown.
    """
    require_positive(sets=sets)
    require_seed(seed)
    if seconds is not None and not seconds > HELD:
        raise InputError(f"seconds is {seconds}; expected more than {HELD:g} s, the time that a plant must stay up")
    if recover not in RECOVERIES:
        raise InputError(f"recover is {recover!r:.40}; choose from {', '.join(RECOVERIES)}")
    upright, estimator = upright_of(model, layout), estimator or by_differences(layout)
    seconds = max(SECONDS, FALLS / upright.scales.fall) if seconds is None else seconds
    results, refused = [], []
    for make in RECOVERIES[recover]:
        try:
            way = make(upright, seed)
            trial = trial_of(
                lambda settings, way=way: estimator(way.controller(settings)), upright.model, layout, hardware,
                seconds=seconds, late=late,
            )  # fmt: skip
            results.append(_chosen(way, trial, estimator, layout, sets=sets, seconds=seconds, seed=seed))
        except InputError as error:
            refused.append(str(error))
        if results and results[-1].margin == max(ERRORS):
            break
    if not results:
        raise InputError("; ".join(refused))
    best = max(results, key=lambda one: (one.way == "energy" and one.margin >= LEAST, one.margin))
    return best._replace(trials=sum(one.trials for one in results))


class Way(NamedTuple):
    """A way of swinging up, with settings chosen by trials."""

    name: str
    draw: Callable[[np.random.Generator, int], list[Any]]
    """(random, count) -> settings, trees of arrays of equal shapes."""
    controller: Callable[[Any], Controller]
    """Settings, perhaps traced -> controller of states."""
    errors: tuple[float, ...]
    """Errors in the first round, one trial each."""
    most_sets: int | None = None
    """Largest number of sets in a round; by default the requested number."""


def _by_energy(upright: Upright, seed: int) -> Way:
    """Returns the way by energy laws and a regulator."""
    draw = lambda random, count: [swing_up_numbers(upright, one) for one in _draws(random, count)]  # noqa: E731
    return Way("energy", draw, lambda one: stateless(law_of(upright, one)), (0.0, 0.0))


def _by_plan(upright: Upright, seed: int) -> Way:
    """Returns the way by plans with feedback; raises as `plans_of`."""
    plans = plans_of(upright, seed=seed)[:PLANS]

    def draw(random: np.random.Generator, count: int) -> list[Any]:
        return with_feedback(upright, [plans[k % len(plans)] for k in range(count)], _draws(random, count))

    return Way("plan", draw, lambda plan: follower(upright, plan), (0.15, -0.15))


def _by_repeated_plans(upright: Upright, seed: int) -> Way:
    """Returns the way by repeated plans, which also recover from pushes, and a regulator."""
    draw = _by_energy(upright, seed).draw
    controller = lambda one: by_repeated_plans(upright, one)  # noqa: E731
    return Way("repeated plans", draw, controller, (0.15, -0.15), SETS_OF_REPEATED_PLANS)


RECOVERIES: Mapping[str, tuple[Callable[[Upright, int], Way], ...]] = {
    "swing-up": (_by_plan, _by_energy),
    "plans": (_by_repeated_plans,),
}
"""Recovery after a push -> methods to try: swing up from hanging again, or plan from the present state."""


def _draws(random: np.random.Generator, count: int) -> list[dict[str, float]]:
    """Returns sets of numbers, alternately with the energy of the passive part and of the whole plant."""
    low, high = np.log(np.array(list(RANGES.values()))).T
    rows = np.exp(random.uniform(low, high, size=(count, len(RANGES))))
    return [{**dict(zip(RANGES, row, strict=True)), "total": float(k % 2)} for k, row in enumerate(rows)]


def _chosen(
    way: Way, trial: Any, estimator: Estimator, layout: Layout, *, sets: int, seconds: float, seed: int
) -> SwingUp:  # fmt: skip
    """Returns the settings of one way with the largest margin."""
    random = np.random.default_rng([seed, 31])
    sets = min(sets, way.most_sets or sets)
    finalists = min(FINALISTS, way.most_sets or FINALISTS)
    lanes = max(sets * len(way.errors), finalists * len(ERRORS) * STARTS)
    program = jax.jit(jax.vmap(trial))
    settings: list[Any] = []
    times = np.zeros((0, len(way.errors)))
    trials = 0

    def tried(chosen: list[Any], errors: tuple[float, ...], starts: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns times and changes of the controls [set, error, start]; idle lanes repeat the first trials."""
        nonlocal trials
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves).astype(float), *chosen)
        count = len(chosen) * len(errors) * starts
        place = np.arange(lanes) % count
        which, error_of, start_of = np.unravel_index(place, (len(chosen), len(errors), starts))
        drawn = layout.hanging + spread_of(layout) * random.normal(size=(starts, len(layout.joints)))
        keys = jax.random.split(jax.random.key(int(random.integers(2**31))), lanes)
        parts = jax.tree.map(lambda leaf: leaf[which], stacked)
        seconds, changes = program(parts, drawn[start_of], np.array(errors)[error_of], keys)
        trials += count
        shape = len(chosen), len(errors), starts
        return np.asarray(seconds)[:count].reshape(shape), np.asarray(changes)[:count].reshape(shape)

    for _ in range(ROUNDS):
        fresh = way.draw(random, sets)
        settings += fresh
        times = np.concatenate([times, tried(fresh, way.errors, 1)[0][:, :, 0]])
        if np.isfinite(times).all(axis=1).sum() >= finalists:
            break
    good = np.isfinite(times).all(axis=1)
    if not good.any():
        raise InputError(
            f"no set of numbers swings the model up by {way.name} within {seconds:.3g} s and its limits "
            f"({len(settings)} sets, {trials} trials, {np.isfinite(times).mean():.0%} came up); try a stronger motor, "
            "wider limits, more time or a better model"
        )
    best = np.argsort(np.where(good, times.max(axis=1), np.inf))[: min(finalists, int(good.sum()))]
    starts = max(STARTS, lanes // (finalists * len(ERRORS)))
    final, changes = tried([settings[k] for k in best], ERRORS, starts)
    more = tried([settings[k] for k in best], (0.0,), max(starts, lanes // len(best)))[0]
    margins = np.array([_margin(np.isfinite(one).all(axis=1)) for one in final])
    share = np.isfinite(final).mean(axis=(1, 2))
    nominal = np.median(final[:, 0], axis=1)
    equal = np.ones(len(best), bool)
    for most in (np.isfinite(more).mean(axis=(1, 2)), margins, share):
        equal &= most == most[equal].max()
    slow = nominal > SLOWER * nominal[equal].min()
    choice = int(np.lexsort((np.median(changes[:, 0], axis=1), slow, ~equal))[0])
    if margins[choice] < 0:
        raise InputError(
            f"no set of numbers swings the model up by {way.name} from all {starts} starts ({trials} trials): the best "
            f"succeeds from {np.isfinite(final[:, 0]).mean(axis=1).max():.0%}; try a stronger motor or wider limits"
        )
    selected = jax.tree.map(jnp.asarray, settings[best[choice]])
    return SwingUp(
        estimator(way.controller(selected)), way.name, selected, trials, float(good.mean()), float(margins[choice]),
        float(nominal[choice]),
    )  # fmt: skip


def trial_of(
    controller: Callable[[Any], Controller],
    model: Dynamics | InverseForward,
    layout: Layout,
    hardware: Hardware,
    *,
    seconds: float,
    late: float,
) -> Callable[[Any, Array, Array, Array], tuple[Array, Array]]:
    """Returns (traced settings, start [d], error of the model, key) -> (seconds, changes).

    The time to the goal is infinite if the plant does not stay there. The changes are root mean squares of the control
    increments over the last second, relative to the limits.
    """
    B, d = layout.actuation, len(layout.joints)
    lower, upper = layout.limits.control.T
    limited = hardware._replace(lower=lower, upper=upper, sees_rates=False)
    angles = np.array([kind == "revolute" for kind in layout.joints])
    low, high = inner_ranges(layout, RESERVE)
    has_limits = np.isfinite(layout.limits.position).any() or np.isfinite(layout.limits.rate).any()

    def within(q: Array, qd: Array) -> Array:
        ahead = q + layout.limits.stopping * qd
        inside = (jnp.minimum(q, ahead) >= low) & (jnp.maximum(q, ahead) <= high)
        return jnp.all(inside & (jnp.abs(qd) <= RESERVE * layout.limits.rate))

    def trial(settings: Any, start: Array, wrong: Array, key: Array) -> tuple[Array, Array]:
        def field(x: Array, u: Array) -> Array:
            q, qd = jnp.split(x, 2)
            weight = model.inverse_dynamics(q, jnp.zeros(d), jnp.zeros(d))
            tau = (1 + wrong) * (B @ u) + WEIGHT * wrong * weight
            return jnp.concatenate([qd, model.forward_dynamics(q, qd, tau)])

        later = _late(controller(settings), jnp.minimum(late + LATE * (wrong > 0), 1.0), lower, upper)
        run = simulate(
            field, later, jnp.concatenate([start, jnp.zeros(d)]), seconds=seconds, rate=layout.rate,
            controls=B.shape[1], hardware=limited, key=key,
        )  # fmt: skip
        off = jax.vmap(lambda x: error(x[:d], layout.goal, layout.joints))(run.x)
        away = ~(jnp.max(jnp.abs(off[:, angles]), axis=1) <= WITHIN * TOLERANCE)  # NaN is away
        last = jnp.max(jnp.where(away, run.t + 1 / layout.rate, 0.0))
        fine = last <= seconds - HELD
        if has_limits:
            # The guard uses measured rates: with noise, it would stop a plan that barely respects the limits.
            measured = (run.y[SPAN:] - run.y[:-SPAN]) * (layout.rate / SPAN)
            fine &= within(run.x[:, :d], run.x[:, d:]) & within(run.y[SPAN:], measured)
        changes = jnp.diff(run.u[-round(HELD * layout.rate) :], axis=0) / (upper - lower)
        return jnp.where(fine, last, jnp.inf), jnp.sqrt(jnp.mean(changes**2))

    return trial


def _late(controller: Controller, share: Array, lower: np.ndarray, upper: np.ndarray) -> Controller:
    """Returns a controller with commands delayed by a share of a sample, as their mean over each sample."""

    def act(memory: Any, t: Array, y: Array) -> tuple[Any, Array]:
        inner, before = memory
        inner, u = controller.act(inner, t, y)
        u = jnp.clip(u, lower, upper)
        return (inner, u), (1 - share) * u + share * before

    return Controller((controller.start, jnp.zeros(len(lower))), act)


def _margin(succeeded: np.ndarray) -> float:
    """Returns the largest error up to which all trials succeeded; negative without any."""
    failed = [abs(error) for error, fine in zip(ERRORS, succeeded, strict=True) if not fine]
    return max((abs(error) for error in ERRORS if not failed or abs(error) < min(failed)), default=-1.0)
