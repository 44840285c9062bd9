"""One short film of each family of models, side by side: the strip on the first page of the documentation.

Each film trains or designs what it shows, and returns a function that prepares its axis and draws its frames.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection

from dln_jax import GaussNewton, Needs, dynamics, fit, flow
from dln_jax.data.splits import hold_out, split
from dln_jax.figures import rotary_pendulum_drawing, style
from dln_jax.learning.dynamics import problem as torque_problem
from dln_jax.learning.rates import problem as rate_problem
from dln_jax.locomotion.gradient import shown_walk, train
from dln_jax.locomotion.learning import Goal
from dln_jax.locomotion.task import creature_named, make_task
from dln_jax.mechanics.integrators import gauss_legendre4, rk4, rollout, second_order
from dln_jax.models.lagrangian import make_delan
from dln_jax.models.n_body import make_pairwise_hamiltonian
from dln_jax.nn.activations import tanh
from dln_jax.scenes.datasets.generators import default_data
from dln_jax.scenes.datasets.hamiltonian_tasks import three_body
from dln_jax.scenes.pendulums import LINK_LENGTH, two_link_arm
from scripts.reports.control.swing_ups import SWING_UPS, closed_loop

Film = Callable[[Axes], Callable[[int], None]]
"""Prepares an axis and returns the function that draws a frame."""
TRAIL = 25
"""Frames of a trace."""


def sampled(motion: ArrayLike, frames: int) -> np.ndarray:
    """Returns as many samples of a motion [T, ...] as there are frames, evenly spaced."""
    values = np.asarray(motion)
    return values[np.linspace(0, len(values) - 1, frames).round().astype(int)]


def writing_arm(frames: int) -> Film:
    """The true arm writes a letter under torques of a DeLaN, with weak feedback beside them."""
    scene = two_link_arm()
    tip = scene.tip
    assert tip is not None
    sets = split(default_data(scene)._replace(needs=scene.needs), test=("e", "q", "v"))
    model = make_delan(scene.needs, width=8, depth=2, activation=tanh, dtype=jnp.float64)
    training = fit(torque_problem(model, sets), GaussNewton(steps=60))
    learned, plant = dynamics(model.energies(training.parameters)), dynamics(scene.energies)
    test = sets.test
    letter = test.trajectory == test.trajectory[0]
    t, *reference = (np.asarray(array[letter]) for array in (test.t, test.q, test.qd, test.qdd))

    def accelerate(time, q, qd):
        wanted = [jnp.stack([jnp.interp(time, t, column) for column in array.T]) for array in reference]
        feedback = 5.0 * (wanted[0] - q) + 1.0 * (wanted[1] - qd)
        return plant.forward_dynamics(q, qd, learned.inverse_dynamics(*wanted) + feedback)

    start = jnp.asarray(reference[0][0]), jnp.asarray(reference[1][0])
    q = np.asarray(jax.jit(lambda start: rollout(rk4(second_order(accelerate)), start, t))(start)[0])
    elbow = LINK_LENGTH * np.stack([np.cos(q[:, 0]), np.sin(q[:, 0])], axis=1)
    joints = sampled(np.stack([0 * elbow, elbow, np.asarray(jax.vmap(tip)(jnp.asarray(q)))], axis=1), frames)
    path = np.asarray(jax.vmap(tip)(jnp.asarray(reference[0])))

    def prepare(axis: Axes) -> Callable[[int], None]:
        axis.plot(*path.T, color="0.85", linewidth=5)
        (links,) = axis.plot([], [], "o-", color="#3b4252", linewidth=5, markersize=7, solid_capstyle="round")
        (trace,) = axis.plot([], [], color=style.BLUE, linewidth=2)
        framed(axis, np.concatenate([joints.reshape(-1, 2), path]))

        def show(frame: int) -> None:
            links.set_data(*joints[frame].T)
            trace.set_data(*joints[: frame + 1, 2].T)

        return show

    return prepare


def three_bodies(frames: int) -> Film:
    """Three bodies move by a Hamiltonian that was learned from rates."""
    task = three_body(trajectories=200)
    model = make_pairwise_hamiltonian(Needs(("prismatic",) * 6), width=8, depth=1, activation=tanh, dtype=jnp.float64)
    sets = hold_out(task.train.data, 0.1, seed=0)
    training = fit(rate_problem(model, *sets), GaussNewton(steps=80))
    learned = flow(model.energies(training.parameters))
    clean = task.test.clean
    assert clean.p is not None
    start = jnp.asarray(clean.q[0]), jnp.asarray(clean.p[0])
    step = gauss_legendre4(lambda t, state: learned.rates(*state))
    q, _ = jax.jit(lambda start: rollout(step, start, jnp.linspace(0, 12, 1201)))(start)
    places = sampled(q, frames).reshape(frames, 3, 2)

    def prepare(axis: Axes) -> Callable[[int], None]:
        colours = (style.BLUE, style.VERMILLION, "#3b4252")
        bodies = [axis.plot([], [], "o", color=colour, markersize=10)[0] for colour in colours]
        traces = [axis.plot([], [], color=colour, linewidth=2, alpha=0.6)[0] for colour in colours]
        framed(axis, places.reshape(-1, 2))

        def show(frame: int) -> None:
            for body, (dot, trace) in enumerate(zip(bodies, traces, strict=True)):
                dot.set_data(*places[frame, body : body + 1].T)
                trace.set_data(*places[max(0, frame - TRAIL) : frame + 1, body].T)

        return show

    return prepare


def swing_up(frames: int) -> Film:
    """A rotary pendulum comes up by its energy, and stays there by a linear-quadratic regulator."""
    run = closed_loop(SWING_UPS["rotary-pendulum"], seconds=4.0)(jnp.array([0.0, np.pi + 0.1, 0.0, 0.0]))
    q = sampled(run.x[:, :2], frames)

    def prepare(axis: Axes) -> Callable[[int], None]:
        return rotary_pendulum_drawing(0.085, 0.129)(axis, q, TRAIL // 3)

    return prepare


def crawler(frames: int) -> Film:
    """A soft body crawls by a policy that was learned through the simulator."""
    task = make_task(creature_named("crawler"))
    trained = train(task, seeds=[0], goal=Goal(steps=20_000, distance=2.0))
    seen = shown_walk(task, trained.policy, trained.best.parameters, 2 * task.episode)
    x, pull = sampled(seen.x, frames), sampled(seen.actuation, frames)
    mesh, muscles = task.creature.mesh, np.asarray(task.creature.muscles)

    def prepare(axis: Axes) -> Callable[[int], None]:
        body = PolyCollection([], facecolors="#f2dcc4", edgecolors="#c9a27e", linewidths=0.6)
        lines = LineCollection([], linewidths=2.5, cmap="Reds_r")
        lines.set_clim(0.2, 1.1)
        axis.add_collection(body)
        axis.add_collection(lines)
        low, high = float(x[..., 0].min()), float(x[..., 0].max())
        axis.axhline(0, color="0.6", linewidth=1.5)
        marks = np.arange(np.floor(low), np.ceil(high) + 1, 0.25 * task.length)
        axis.plot(marks, 0 * marks, "|", color="0.6", markersize=8, markeredgewidth=1.5, zorder=0)
        axis.set(ylim=(-0.3 * task.length, 1.0 * task.length), aspect="equal")
        axis.set_axis_off()

        def show(frame: int) -> None:
            middle = x[frame, :, 0].mean()
            axis.set_xlim(middle - 0.75 * task.length, middle + 0.75 * task.length)
            body.set_verts(list(x[frame][mesh.elements]))
            lines.set_segments(list(x[frame][muscles]))
            lines.set_array(pull[frame])

        return show

    return prepare


FILMS: dict[str, Callable[[int], Film]] = {
    "DeLaN: learned torques": writing_arm,
    "HNN: learned energy": three_bodies,
    "control by energy": swing_up,
    "soft body: learned gait": crawler,
}
"""Films by title, in the order of the strip."""


def framed(axis: Axes, points: np.ndarray) -> None:
    """Sets equal scales and limits that hold all points, and leaves the frame out."""
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.08 * max(high - low)
    axis.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin), aspect="equal")
    axis.set_axis_off()
