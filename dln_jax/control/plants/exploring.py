"""Motions to learn any plant from, without a model of it: smooth noise first, then energy laws of what was learned.

1. Blind episodes: smooth noise, with a spring and a damper that are scaled by the limits of motors and coordinates. An
   episode that `guarded` stops halves the noise of the next.
2. A model is fitted. The others are episodes of its energy law, some to below and some to above the energy of the goal,
   with noise; it is fitted again on the way.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.control.closed_loop import Controller
from dln_jax.control.energy_shaping import energy_shaping
from dln_jax.control.plants.estimators import by_differences
from dln_jax.control.plants.plant import Layout, Plant
from dln_jax.control.plants.runs import PlantRun, compiled, run
from dln_jax.control.plants.scales import USUAL, circle, gains_of, scales_of
from dln_jax.control.swing_up import upright_of
from dln_jax.data.encoders import low_pass
from dln_jax.data.schema import Trajectories
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.types import InputError, require_positive, require_seed

DAMPING = 0.15
"""Damping of the blind episodes' spring over its stiffness, s."""
FITTED_EVERY = 2
"""Number of later episodes after which the model is fitted again."""
SHORTEST = 1.0
"""Shortest episode that is kept, s."""


class Exploration(NamedTuple):
    """Settings of an exploration."""

    seconds: float = 30.0
    """Duration of all episodes."""
    blind: tuple[float, ...] = (0.3, 0.6)
    """Standard deviations of the noise of the blind episodes, as shares of the limits."""
    surplus: tuple[float, ...] = (-0.5, 0.2, 0.6, 1.0)
    """Energies to which the other episodes drive the passive joints, above that of the goal, as shares of the energy
    from hanging to the goal."""
    noise: float = 0.3
    """Standard deviation of their noise, as a share of the limits."""
    bandwidth: float = 3.0
    """Bandwidth of the noise, Hz."""
    share: float = 0.8
    """Largest share of the motors' limits that is used."""


class Explored(NamedTuple):
    """What was recorded."""

    recording: Trajectories
    """t, q and the commanded torques, without rates."""
    stopped: tuple[str, ...]
    """Reasons of the episodes that were stopped."""


def explore(
    plant: Plant,
    fit: Callable[[Trajectories], Dynamics],
    exploration: Exploration = Exploration(),  # noqa: B008
    *,
    seed: int = 0,
) -> Explored:
    """Records episodes of a plant.

    Args:
        plant: any; it is guarded.
        fit: recording -> model, for the later episodes; where it raises `InputError`, the episode is blind.
        exploration: settings.
        seed: of the noise.

    Raises:
        InputError: settings out of range, a start outside the limits, or a plant that is stopped every time.
    """
    require_seed(seed)
    require_positive(seconds=exploration.seconds, bandwidth=exploration.bandwidth, share=exploration.share)
    layout, random = plant.layout, np.random.default_rng([seed, 37])
    used = layout.limits._replace(control=exploration.share * layout.limits.control)
    inner = layout._replace(limits=used)
    stages = [*exploration.blind, *exploration.surplus]
    seconds = exploration.seconds / len(stages)
    runs: list[PlantRun] = []
    stopped: list[str] = []
    weaker, blind, shaped = 1.0, compiled(_blind(inner), inner), None
    for number, stage in enumerate(stages):
        later = number - len(exploration.blind)
        if later >= 0 and later % FITTED_EVERY == 0:
            shaped = _energy_law(inner, fit, runs) or shaped
        if later >= 0 and shaped is not None:
            act, noise = shaped, exploration.noise
        else:
            act, noise = blind, exploration.blind[min(number, len(exploration.blind) - 1)]
        samples = round(seconds * layout.rate)
        signal = smooth_noise((samples, layout.actuation.shape[1]), rate=layout.rate, bandwidth=exploration.bandwidth,
                              random=random)  # fmt: skip
        size = weaker * noise * used.control[:, 1]
        memory = (_rates(inner).start, jnp.asarray(size * signal), jnp.asarray(stage))
        (one,) = run([plant], act, jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], memory), seconds=seconds)
        if one.stopped:
            weaker /= 2
            stopped.append(one.stopped)
        if len(one.t) >= SHORTEST * layout.rate:
            runs.append(one)
    if len(runs) < 2:
        raise InputError(
            f"the plant was stopped in {len(stopped)} of {len(stages)} episodes ({stopped[-1]}); expected two of at "
            f"least {SHORTEST:g} s: widen its limits or weaken its motors"
        )
    return Explored(recording_of(runs, layout), tuple(stopped))


def smooth_noise(
    shape: tuple[int, ...], *, rate: float, bandwidth: float, random: np.random.Generator
) -> Float[np.ndarray, "N m"]:
    """Normal noise of unit deviation below a frequency, [N, m] at a rate in Hz."""
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


def _rates(layout: Layout) -> Controller:
    """Passes on measurements and their rates."""
    return by_differences(layout)(lambda x: x)


def _with(law: Callable[[Array, Array], Array], layout: Layout) -> Controller:
    """(x, number of the stage) -> u, plus the noise of the memory (rates, noise [N, m], number)."""
    rates = _rates(layout)

    def act(memory: Any, t: Array, y: Array) -> tuple[Any, Array]:
        inner, noise, number = memory
        inner, x = rates.act(inner, t, y)
        place = jnp.clip(jnp.round(t * layout.rate).astype(int), 0, len(noise) - 1)
        return (inner, noise, number), law(x, number) + noise[place]

    return Controller(None, act)


def _spring(layout: Layout, centre: np.ndarray) -> Callable[[Array], Array]:
    """x -> share of the limits [m], of a spring and a damper that keep the active joints around a centre."""
    active = np.flatnonzero((layout.actuation != 0).any(axis=1))
    d, (low, high) = len(layout.joints), layout.limits.position[active].T
    reach = np.minimum(np.minimum(high - centre[active], centre[active] - low), np.pi)

    def spring(x: Array) -> Array:
        return 2 * (x[active] - centre[active] + DAMPING * x[d + active]) / reach

    return spring


def _blind(layout: Layout) -> Controller:
    spring, size = _spring(layout, layout.hanging), layout.limits.control[:, 1]
    return _with(lambda x, _: jnp.asarray(-size * spring(x)), layout)


def _energy_law(layout: Layout, fit: Callable[[Trajectories], Dynamics], runs: list[PlantRun]) -> Any:
    """The compiled energy law of a model of the runs so far, whose number is its surplus; `None` without a model."""
    if len(runs) < 2:
        return None
    lower, upper = layout.limits.control.T
    try:
        model = fit(recording_of(runs, layout))
        upright = upright_of(model, layout.actuation, layout.goal, postures=circle(layout), lower=lower, upper=upper)
        scales = scales_of(upright, layout)
    except InputError:
        return None
    home = jnp.split(upright.at.x, 2)[0]
    gains, size = gains_of(scales, USUAL), layout.limits.control[:, 1]
    to_controls = jnp.linalg.pinv(layout.actuation[np.array(upright.parts.active)])
    spring = _spring(layout, layout.goal)

    def law(x: Array, surplus: Array) -> Array:
        shaped = energy_shaping(upright.model, upright.parts, home, gains, surplus=surplus * scales.energy)
        q, qd = jnp.split(x, 2)
        # Beyond half of the reach the spring pushes back, whatever the model says.
        pull = spring(x)
        u = jnp.clip(to_controls @ shaped(q, qd), lower, upper)
        return u - 2 * size * (pull - jnp.clip(pull, -1.0, 1.0))

    return compiled(_with(law, layout), layout)
