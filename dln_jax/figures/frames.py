"""The energy-injection picture: a motion in the latent plane whose energy is raised halfway, as the decoder shows it.

The energy is raised along its own gradient, dz/ds = grad H / |grad H|², which adds s to H: the shortest way up. H is
counted from the rod at rest, whose latent state is where the encoder puts two frames of it hanging still.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from dln_jax.datasets.pendulum_frames import FRAME_TIME, pictures
from dln_jax.figures import style
from dln_jax.mechanics.equations import flow
from dln_jax.mechanics.flow import Flow
from dln_jax.mechanics.integrators import rk4, rollout
from dln_jax.metrics.frames import decoded, encoded, physical_energy, physical_states
from dln_jax.metrics.phase_space import Motions, predict
from dln_jax.models.latent_phase import LatentModel
from dln_jax.models.model import Parameters
from dln_jax.precision import in_float64, with_float64
from dln_jax.types import Hamiltonian, InputError, Scalar, Vector, require_positive

_CLIMB, _CORRECTIONS = 20, 3


class Injection(NamedTuple):
    """A motion of `times` frames before the energy is raised, and as many after, all in one."""

    latent: Motions
    """One motion [1, 2 times, 1], by frame number; both states of the moment of injection are in it."""
    pairs: Float[np.ndarray, "T input"]
    """Decoded."""
    level: Float[np.ndarray, " T"]
    """Latent H above rest, relative to that at the start."""
    physical: Float[np.ndarray, " T"]
    """Energy read from the frames, in J."""


def raise_energy(H: Hamiltonian, q: Vector, p: Vector, wanted: Scalar) -> tuple[Vector, Vector]:
    """The state with H = wanted that is reached from (q, p) along the gradient of H; it must not vanish on the way."""

    def direction(state: tuple[Vector, Vector]) -> tuple[Vector, Vector]:
        slopes = jax.grad(H, argnums=(0, 1))(*state)
        square = sum(jnp.sum(slope**2) for slope in slopes)
        return slopes[0] / square, slopes[1] / square

    step = rk4(lambda s, state: direction(state))
    levels = jnp.linspace(0.0, 1.0, _CLIMB + 1) * (wanted - H(q, p))
    climbed = rollout(step, (q, p), levels)
    state = climbed[0][-1], climbed[1][-1]
    for _ in range(_CORRECTIONS):
        slopes, missing = direction(state), wanted - H(*state)
        state = state[0] + missing * slopes[0], state[1] + missing * slopes[1]
    return state


@in_float64
def inject_energy(
    model: LatentModel,
    parameters: Parameters,
    pair: Float[np.ndarray, " input"],
    *,
    factor: float = 2.0,
    times: int = 50,
) -> Injection:
    """The motion from two frames, with `factor` times the energy from the frame number `times` on.

    Raises:
        InputError: a model without an energy, or a factor or times that are not positive.
    """
    require_positive(factor=factor, times=times)
    parameters = with_float64(parameters)
    field = flow(model.field.energies(parameters["field"]))
    if not isinstance(field, Flow):
        raise InputError("the model has no energy to raise; give one whose latent field is a black-box-hnn")
    H = field.energy
    still = np.tile(pictures(np.zeros(1))[0], 2)
    q, p = encoded(model, parameters, np.stack([pair, still]))
    ground = H(jnp.asarray(q[1]), jnp.asarray(p[1]))
    start = H(jnp.asarray(q[0]), jnp.asarray(p[0])) - ground
    t = np.arange(float(times))

    def move(q: np.ndarray, p: np.ndarray) -> Motions:
        return predict(model.field, parameters["field"], q[None], p[None], t)

    before = move(q[0], p[0])
    climb = jax.jit(functools.partial(raise_energy, H))
    kicked = climb(jnp.asarray(before.q[0, -1]), jnp.asarray(before.p[0, -1]), ground + factor * start)
    after = move(*map(np.asarray, kicked))
    latent = Motions(
        np.concatenate([t, t[-1] + t]),
        np.concatenate([before.q, after.q], axis=1),
        np.concatenate([before.p, after.p], axis=1),
    )
    pairs = decoded(model, parameters, latent)[0]
    levels = jax.vmap(H)(jnp.asarray(latent.q[0]), jnp.asarray(latent.p[0]))
    return Injection(latent, pairs, np.asarray((levels - ground) / start), physical_energy(*physical_states(pairs)))


def injection_figure(injection: Injection, *, shown: int = 7) -> Figure:
    """Decoded frames before and after, the latent path, and the energies against time."""
    require_positive(shown=shown)
    total = len(injection.level)
    half = total // 2
    side = round(np.sqrt(injection.pairs.shape[1] // 2))
    figure = style.blank(height=5.0)
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=[1.0, 1.05])[:, 0]
    colours = style.BLUE, style.VERMILLION
    rows = upper.subplots(2, shown, squeeze=False)
    for row, first, colour, name in zip(rows, (0, half), colours, ("before", "after"), strict=True):
        for axis, index in zip(row, np.linspace(first, first + half - 1, shown).astype(int), strict=True):
            axis.imshow(injection.pairs[index, : side * side].reshape(side, side), cmap="gray", vmin=0, vmax=1)
            axis.set(xticks=[], yticks=[])
            time = f"{FRAME_TIME * injection.latent.t[index]:.2f} s"
            style.title(axis, time, fontsize=style.SMALL, color=colour)
        row[0].set_ylabel(name, color=colour, fontsize=style.TEXT)
    plane, levels = lower.subplots(1, 2, width_ratios=[1.0, 1.6])
    joules = levels.twinx()
    for axis in (plane, levels, joules):
        style.prepare(axis)
    q, p = injection.latent.q[0, :, 0], injection.latent.p[0, :, 0]
    t = FRAME_TIME * injection.latent.t
    for part, colour in zip((slice(0, half), slice(half, total)), colours, strict=True):
        plane.plot(q[part], p[part], color=colour, linewidth=1.5)
        levels.plot(t[part], injection.level[part], color=colour, linewidth=5.0, alpha=0.4)
        joules.plot(t[part], injection.physical[part], ":", color="black", linewidth=1.6)
    plane.annotate("", (q[half], p[half]), (q[half - 1], p[half - 1]), arrowprops={"arrowstyle": "->", "lw": 1.6})
    plane.set(xlabel="latent q, 1", ylabel="latent p, 1 per frame")
    style.title(plane, "path in the latent plane")
    levels.set(xlabel="t, s", ylabel="latent H / H at the start, 1")
    style.title(levels, "energy: latent (band), of the frames (dots)")
    joules.set_ylabel("energy of the frames, J")
    joules.grid(False)
    joules.spines["right"].set_visible(True)
    start = injection.physical[:half].mean()
    top = 1.25 * max(float(injection.level.max()), float(injection.physical.max() / start))
    levels.set_ylim(0.0, top)
    joules.set_ylim(0.0, top * start)
    return figure
