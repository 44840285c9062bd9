"""Exploratory motions of a plant in its hardware: an energy law from a rough model, plus smooth noise.

A recording holds what the hardware measures: the encoders' readings and the commanded torques, before delay and noise.
`data.encoders` estimates rates and accelerations.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.control.closed_loop import ClosedLoopRun, Controller, hanging_starts, simulate
from dln_jax.control.desktop_plants import CUTOFF, DesktopPlant, model_of_plant
from dln_jax.control.observers import with_differences
from dln_jax.control.state_space import Law, field_of, saturated
from dln_jax.control.swing_up import EnergyGains, energy_shaping, parts_of, passive_energy
from dln_jax.data.encoders import low_pass
from dln_jax.data.schema import Trajectories
from dln_jax.mechanics.equations import dynamics
from dln_jax.types import require_positive, require_seed


class Excitation(NamedTuple):
    """Settings of an exploration."""

    seconds: float = 30.0
    """Total duration of all episodes."""
    episodes: int = 5
    wrong: float = 0.25
    """Relative error of the rough model's sizes, up or down at random."""
    surplus: tuple[float, float] = (-0.5, 1.0)
    """Energies to which the first and the last episode drive the pole, above that of the goal, as shares of the energy
    that lifts it from hanging in the rough model; those of the other episodes are interpolated."""
    noise: float = 0.3
    """Standard deviation of the smooth noise, as a share of the limits."""
    bandwidth: float = 3.0
    """Bandwidth of the noise, Hz."""
    share: float = 0.8
    """Largest share of the limits that is used."""
    cutoff: float = CUTOFF
    """Cut-off frequency of the law's rates, Hz."""


def smooth_noise(
    shape: tuple[int, ...], *, rate: float, bandwidth: float, random: np.random.Generator
) -> Float[np.ndarray, "N m"]:
    """Normal noise of unit deviation below a frequency, [N, m] at a rate in Hz."""
    noise = low_pass(random.normal(size=shape), rate=rate, cutoff=bandwidth)
    return noise / noise.std(axis=0)


def with_noise(law: Law, noise: Any, *, rate: float, cutoff: float) -> Controller:
    """Wraps a law of (q, qd), with rates from differences of q, and adds noise [N, m] sample by sample."""
    # The noise is part of the memory, so that a batch of controllers is a batch of memories.
    inner = with_differences(law, 2, rate=rate, cutoff=cutoff)

    def act(memory: Any, t: Array, y: Array) -> tuple[Any, Array]:
        before, noise = memory
        after, u = inner.act(before, t, y)
        return (after, noise), u + noise[jnp.round(t * rate).astype(int)]

    return Controller((inner.start, noise), act)


def explore(
    plant: DesktopPlant,
    gains: EnergyGains,
    excitation: Excitation = Excitation(),  # noqa: B008
    *,
    seed: int = 0,
) -> tuple[Trajectories, ClosedLoopRun]:
    """Returns a recording of t, q and the commanded torques, without rates, and the true runs for evaluation.

    Args:
        plant: the true plant with its sensors and actuators, with friction that the rough model lacks.
        gains: of the energy law, whose goal is the upright pole.
        excitation: settings.
        seed: of the rough model, the noise, the starts and the hardware.

    Raises:
        InputError: settings out of range.
    """
    require_seed(seed)
    require_positive(
        seconds=excitation.seconds, episodes=excitation.episodes, bandwidth=excitation.bandwidth, share=excitation.share
    )
    random = np.random.default_rng([seed, 17])
    rate, B = plant.rate, np.asarray(plant.scene.needs.actuation)
    sizes = {name: size * (1 + excitation.wrong * random.choice([-1.0, 1.0])) for name, size in plant.sizes.items()}
    rough = dynamics(plant.nominal(**sizes).closed_form)
    parts = parts_of(B)
    lift = passive_energy(rough, parts, jnp.zeros(2))(jnp.array([0.0, np.pi]), jnp.zeros(2))
    surplus = -lift * jnp.linspace(*excitation.surplus, excitation.episodes)
    limit = excitation.share * np.broadcast_to(plant.hardware.upper, B.shape[1])
    hardware = plant.hardware._replace(lower=-limit, upper=limit)
    episodes, samples = excitation.episodes, round(excitation.seconds / excitation.episodes * rate)
    noise = smooth_noise((samples, episodes), rate=rate, bandwidth=excitation.bandwidth, random=random)
    field = field_of(model_of_plant(plant), B)

    @jax.jit
    @jax.vmap
    def episode(x: Array, surplus: Array, noise: Array, key: Array) -> tuple[ClosedLoopRun, Array]:
        law = energy_shaping(rough, parts, jnp.zeros(2), gains, surplus=surplus)
        controller = with_noise(
            lambda x: law(x[:2], x[2:]), excitation.noise * limit * noise[:, None], rate=rate, cutoff=excitation.cutoff
        )
        run = simulate(
            field, controller, x, seconds=samples / rate, rate=rate, controls=B.shape[1], hardware=hardware, key=key,
            substeps=plant.substeps,
        )  # fmt: skip

        def command(memory: Any, sample: tuple[Array, Array]) -> tuple[Any, Array]:
            memory, u = controller.act(memory, *sample)
            return memory, saturated(u, -limit, limit)

        # The controls that acted are late and noisy: those that were commanded follow from the measurements.
        return run, jax.lax.scan(command, controller.start, (run.t[:-1], run.y))[1]

    starts = hanging_starts(episodes, int(random.integers(2**31)), position=plant.position)
    keys = jax.random.split(jax.random.key(int(random.integers(2**31))), episodes)
    runs, commands = jax.tree.map(np.asarray, episode(starts, surplus, noise.T, keys))
    return recording(runs, commands @ B.T, plant), runs


def recording(runs: ClosedLoopRun, tau: Float[np.ndarray, "E N d"], plant: DesktopPlant) -> Trajectories:
    """Joins episodes into one log of q and torques, with the needs of the manufacturer's model: without friction."""
    episodes, samples, d = runs.y.shape
    q = np.asarray(runs.y).reshape(-1, d)
    absent = np.full_like(q, np.nan)
    return Trajectories(
        t=np.tile(np.arange(samples) / plant.rate, episodes),
        q=q,
        qd=absent,
        qdd=absent,
        tau=tau.reshape(-1, d),
        trajectory=np.repeat(np.arange(episodes), samples),
        label=np.array([f"episode-{number}" for number in range(episodes)]),
        needs=plant.scene.needs,
        estimated=("qd", "qdd"),
    )
