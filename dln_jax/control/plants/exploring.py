"""Motions for learning any plant without a model: first smooth noise, then energy laws of a learned model.

1. Blind episodes: smooth noise, with a spring and a damper scaled by the limits of motors and coordinates. If `guarded`
   stops an episode, later episodes have half the noise, and the rest of its time is repeated once.
2. A model is fitted. The other episodes follow its energy law, with noise, to energies below and above the goal; the
   model is refitted on the way.
3. If no episode came near the goal, the model does not know the weight there. This happens with an acrobot, because its
   motor hardly moves the passive joint. The remaining episodes follow a plan of the model to the goal, with less noise.
"""

from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.control.closed_loop import Controller
from dln_jax.control.energy_shaping import energy_shaping
from dln_jax.control.observers import by_differences
from dln_jax.control.plants.planned import READY, follower, plans_of, with_feedback
from dln_jax.control.plants.plant import Layout, Plant
from dln_jax.control.plants.runs import PlantRun, compiled, distances, run
from dln_jax.control.swing_up import USUAL, Upright, swing_up_numbers, upright_of
from dln_jax.data.encoders.filters import low_pass
from dln_jax.data.schema import Trajectories
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.types import InputError, require_positive, require_seed

DAMPING = 0.15
"""Damping of the spring in blind episodes, divided by its stiffness, s."""
FITTED_EVERY = 2
"""Number of later episodes between two fits of the model."""
NEAR = 0.5
"""Largest distance of every angle from the goal that counts as near, rad."""
SHORTEST = 1.0
"""Shortest useful episode, s."""


class Exploration(NamedTuple):
    """Settings of an exploration."""

    seconds: float = 30.0
    """Duration of all episodes."""
    blind: tuple[float, ...] = (0.3, 0.6)
    """Standard deviations of the noise of the blind episodes, as shares of the limits."""
    surplus: tuple[float, ...] = (-0.5, 0.2, 0.6, 1.0)
    """Target energies of the passive joints in the other episodes, relative to the goal, as shares of the energy from
    hanging to the goal."""
    noise: float = 0.3
    """Standard deviation of their noise, as a share of the limits."""
    along_plans: float = 0.1
    """The same for episodes that follow plans; their feedback has less margin."""
    bandwidth: float = 3.0
    """Bandwidth of the noise, Hz."""
    share: float = 0.8
    """Largest used share of the motors' limits."""


class Explored(NamedTuple):
    """Result of an exploration."""

    recording: Trajectories
    """t, q and the commanded torques, without rates."""
    stopped: tuple[str, ...]
    """Reasons why episodes were stopped."""


def explore(
    plant: Plant,
    fit: Callable[[Trajectories], Dynamics],
    exploration: Exploration,
    *,
    seed: int = 0,
) -> Explored:
    """Records episodes of a plant.

    Args:
        plant: any; it is guarded.
        fit: recording -> model, for the later episodes; if it raises `InputError`, the episode is blind.
        exploration: settings.
        seed: seed of the noise.

    Raises:
        InputError: a setting is out of range, a start is outside the limits, or fewer than two episodes were long
            enough.
    """
    require_seed(seed)
    require_positive(seconds=exploration.seconds, bandwidth=exploration.bandwidth, share=exploration.share)
    layout, random = plant.layout, np.random.default_rng([seed, 37])
    used = layout.limits._replace(control=exploration.share * layout.limits.control)
    inner = layout._replace(limits=used)
    stages = [*exploration.blind, *exploration.surplus]
    waiting = deque((number, stage, exploration.seconds / len(stages)) for number, stage in enumerate(stages))
    repeated: set[int] = set()
    runs: list[PlantRun] = []
    stopped: list[str] = []
    weaker, blind, law = 1.0, _blind(inner), _Law()
    while waiting:
        number, stage, seconds = waiting.popleft()
        later = number - len(exploration.blind)
        if later >= 0 and (law.by_plan or later % FITTED_EVERY == 0):
            law = _fitted_law(inner, fit, runs, law, may_plan=later > 0, seed=seed)
        if later >= 0 and law.act is not None:
            act, noise = law.act, exploration.along_plans if law.by_plan else exploration.noise
        else:
            act, noise = blind, exploration.blind[min(number, len(exploration.blind) - 1)]
        samples = round(seconds * layout.rate)
        signal = smooth_noise((samples, layout.actuation.shape[1]), rate=layout.rate, bandwidth=exploration.bandwidth,
                              random=random)  # fmt: skip
        size = weaker * noise * used.control[:, 1]
        memory = (_start(inner, READY if law.by_plan else stage), jnp.asarray(size * signal))
        (one,) = run([plant], act, jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], memory), seconds=seconds)
        if one.stopped:
            weaker /= 2
            stopped.append(one.stopped)
            left = seconds - len(one.t) / layout.rate
            if number not in repeated and left >= SHORTEST:
                repeated.add(number)
                waiting.appendleft((number, stage, left))
        if len(one.t) >= SHORTEST * layout.rate:
            runs.append(one)
    if len(runs) < 2:
        episodes = len(stages) + len(repeated)
        raise InputError(
            f"the plant was stopped in {len(stopped)} of {episodes} episodes ({stopped[-1]}); expected two of at "
            f"least {SHORTEST:g} s: widen its limits or weaken its motors"
        )
    return Explored(recording_of(runs, layout), tuple(stopped))


def smooth_noise(
    shape: tuple[int, ...], *, rate: float, bandwidth: float, random: np.random.Generator
) -> Float[np.ndarray, "N m"]:
    """Returns normal noise of unit deviation below a frequency, [N, m] at a rate in Hz."""
    noise = low_pass(random.normal(size=shape), rate=rate, cutoff=bandwidth)
    return noise / noise.std(axis=0)


def recording_of(runs: list[PlantRun], layout: Layout) -> Trajectories:
    """Joins runs into one log of q and commanded torques."""
    q = np.concatenate([one.y for one in runs])
    absent = np.full_like(q, np.nan)
    return Trajectories(
        t=np.concatenate([one.t for one in runs]),
        q=q,
        qd=absent,
        qdd=absent,
        tau=np.concatenate([one.u for one in runs]) @ layout.actuation.T,
        trajectory=np.repeat(np.arange(len(runs)), [len(one.t) for one in runs]),
        label=np.array([f"episode-{number}" for number in range(len(runs))]),
        needs=layout.needs,
        estimated=("qd", "qdd"),
    )


def _start(layout: Layout, number: float | int) -> Any:
    """Returns the memory of `by_differences` before the first sample, for a controller with a number as memory."""
    return by_differences(layout)(Controller(jnp.asarray(number), lambda memory, t, x: (memory, x))).start


def _with_noise(states: Controller, layout: Layout) -> Any:
    """Compiles a controller of states for measurements, with noise; its memory is (memory from `_start`, noise [N,
    m])."""
    controller = by_differences(layout)(states)

    def act(memory: Any, t: Array, y: Array) -> tuple[Any, Array]:
        inner, noise = memory
        inner, u = controller.act(inner, t, y)
        place = jnp.clip(jnp.round(t * layout.rate).astype(int), 0, len(noise) - 1)
        return (inner, noise), u + noise[place]

    return compiled(Controller(None, act), layout)


def _spring(layout: Layout, centre: np.ndarray) -> Callable[[Array], Array]:
    """Returns x -> share of the limits [m] of a spring and a damper that keep the active joints around a centre."""
    active = np.flatnonzero((layout.actuation != 0).any(axis=1))
    d, (low, high) = len(layout.joints), layout.limits.position[active].T
    reach = np.minimum(np.minimum(high - centre[active], centre[active] - low), np.pi)

    def spring(x: Array) -> Array:
        return 2 * (x[active] - centre[active] + DAMPING * x[d + active]) / reach

    return spring


def _blind(layout: Layout) -> Any:
    spring, size = _spring(layout, layout.hanging), layout.limits.control[:, 1]
    return _with_noise(Controller(None, lambda stage, t, x: (stage, jnp.asarray(-size * spring(x)))), layout)


class _Law(NamedTuple):
    """Compiled law of the later episodes; `None` until there is a model."""

    act: Any = None
    by_plan: bool = False


def _fitted_law(
    layout: Layout, fit: Callable[[Trajectories], Dynamics], runs: list[PlantRun], before: _Law, *, may_plan: bool,
    seed: int,
) -> _Law:  # fmt: skip
    """Returns the law of a model of the runs so far, or the previous law if there is no model or plan."""
    if len(runs) < 2:
        return before
    try:
        upright = upright_of(fit(recording_of(runs, layout)), layout)
    except InputError:
        return before
    near = any((distances(one.y, layout) < NEAR).any() for one in runs)
    if before.by_plan or (may_plan and not near):
        try:
            (plan,) = with_feedback(upright, plans_of(upright, seed=seed)[:1], [USUAL])
            return _Law(_with_noise(follower(upright, plan), layout), by_plan=True)
        except InputError:
            pass
    return before if before.by_plan else _Law(_energy_law(upright))


def _energy_law(upright: Upright) -> Any:
    """Returns the compiled energy law of a model; the number in its memory is the surplus."""
    layout, home = upright.layout, jnp.split(upright.at.x, 2)[0]
    gains, size = swing_up_numbers(upright, USUAL).gains, layout.limits.control[:, 1]
    spring = _spring(layout, layout.goal)

    def law(surplus: Array, t: Array, x: Array) -> tuple[Array, Array]:
        wanted = surplus * upright.scales.energy
        shaped = energy_shaping(upright.model, upright.parts, home, gains, surplus=wanted)
        # Beyond half of the reach the spring pushes back, independent of the model.
        pull = spring(x)
        u = jnp.clip(upright.controls(shaped(*jnp.split(x, 2))), *layout.limits.control.T)
        return surplus, u - 2 * size * (pull - jnp.clip(pull, -1.0, 1.0))

    return _with_noise(Controller(None, law), layout)
