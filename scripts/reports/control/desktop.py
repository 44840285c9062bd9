"""Swing-ups of poles of desktop size: by known and learned models, and by filters instead of differences."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.control import (
    Controller,
    EnergyGains,
    Hardware,
    energy_shaping,
    field_of,
    holding_controls,
    integrated,
    linearise,
    lqr,
    parts_of,
    regulated,
    simulate,
    switched,
    value,
    with_differences,
)
from dln_jax.control.closed_loop import Outcomes, hanging_starts, outcomes
from dln_jax.control.desktop_plants import (
    SECONDS,
    TURN,
    DesktopPlant,
    desktop_plant,
    law_of,
    model_of_plant,
    try_starts,
)
from dln_jax.control.estimate import belief, extended, filtered, from_log, unscented
from dln_jax.control.plants.estimators import by_differences, by_filter
from dln_jax.control.state_space import Law, saturated
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.poles import cart_pole, rotary_pendulum
from dln_jax.scenes.scene import Scene
from dln_jax.training.swing_ups.learned import errors_along, obtain, recorded, test_motions
from dln_jax.types import InputError
from scripts.reports.run import Numbers

RATE = 500.0
"""Rate of the controllers, Hz."""


class Pole(NamedTuple):
    """A plant with one free pole, and the numbers of its law."""

    scene: Scene
    gains: EnergyGains
    state_cost: np.ndarray
    control_cost: float
    limit: float
    """Limit of force or torque, N or N m."""
    level: float
    """Level of the regulator's value below which it acts."""
    encoder: float
    """Resolution of the driven coordinate's encoder, m or rad."""
    position: float
    """Standard deviation of the driven coordinate at the start, m or rad."""


def pole(name: str) -> Pole:
    """A cart-pole or a rotary pendulum."""
    if name == "cart-pole":
        scene = cart_pole(cart_mass=0.57, pole_mass=0.127, length=0.16825, friction=0.002)
        cost = np.diag([10.0, 1.0, 0.1, 0.1])
        return Pole(scene, EnergyGains(2000.0, 10.0, 4.0), cost, 0.1, 10.0, 1.0, 2.3e-5, 0.02)
    scene, cost = rotary_pendulum(friction=1e-5), np.diag([1.0, 1.0, 0.01, 0.01])
    return Pole(scene, EnergyGains(2e7, 20.0, 5.0), cost, 50.0, 0.05, 0.1, TURN, 0.1)


def laws(case: Pole) -> tuple[Law, Law]:
    """The regulator, and the energy law that it takes over from."""
    system, B, joints = dynamics(case.scene.energies), np.asarray(case.scene.needs.actuation), case.scene.needs.joints
    goal = jnp.zeros(4)
    at = linearise(field_of(system, B), goal, holding_controls(system, goal[:2], B))
    gains = lqr(at.A, at.B, case.state_cost, [[case.control_cost]])
    swing, near = energy_shaping(system, parts_of(B), goal[:2], case.gains), regulated(gains, goal, at.u, joints)
    return near, switched(lambda x: swing(x[:2], x[2:]), near, value(gains, goal, joints), case.level)


def known_models(*, plant: str, anywhere: bool = False, starts: int = 1000) -> Numbers:
    """Starts near hanging, or over the pole's phase plane, that are up after ten seconds, from encoders alone."""
    case = pole(plant)
    field = field_of(dynamics(case.scene.energies), np.asarray(case.scene.needs.actuation))
    controller = with_differences(laws(case)[1], 2, rate=RATE, cutoff=50.0)
    lab = Hardware(-case.limit, case.limit, encoder_step=np.array([case.encoder, TURN]), delay=1, sees_rates=False)
    x = hanging_starts(starts, 0, position=case.position)
    if anywhere:
        random, x = np.random.default_rng(1), np.zeros((starts, 4))
        x[:, 1], x[:, 3] = random.uniform(-np.pi, np.pi, starts), random.uniform(-15.0, 15.0, starts)

    def angle(start):
        run = simulate(field, controller, start, seconds=SECONDS, rate=RATE, controls=1, hardware=lab)
        return run.x[:, 1]

    result = outcomes(jax.jit(jax.vmap(angle))(x), rate=RATE)
    measured = {"success_share": result.share, "no_number": float(result.failed.sum())}
    times = {"seconds_median": result.median, "seconds_worst": result.worst}
    return {f"{'starts' if anywhere else 'swing-up'}/{plant}/known": {**measured, **times}}


def learned(*, plant: str, model: str, seeds: int = 3, starts: int = 1000) -> Numbers:
    """Swing-ups by models of several recordings of 30 s, each with starts of its own, and errors on unseen motions."""
    desk, tries, errors, spent = desktop_plant(plant), [], [], []
    for seed in range(seeds):
        obtained = obtain(desk, model, recorded(desk, seconds=30.0, seed=seed), seed=seed)
        spent.append(obtained.seconds)
        errors.append(errors_along(desk, obtained.dynamics, test_motions(desk, seed=seed)))
        try:
            # The gains were chosen on other starts.
            tries.append(try_starts(desk, obtained.dynamics, starts=starts, seed=seed + 100).outcomes)
        except InputError:  # the controller rejects the model: all starts fail
            tries.append(Outcomes(np.full(starts, np.inf), np.zeros(starts, bool)))
    torque, acceleration = np.array(errors).T
    numbers = {
        "success_share": min(one.share for one in tries),
        "not_finite_share": max(np.mean(one.failed) for one in tries),
        "seconds_median": np.median([one.median for one in tries]),
        "seconds_worst": max(one.worst for one in tries),
        "torque_nmse_median": np.median(torque),
        "torque_nmse_worst": torque.max(),
        "acceleration_nmse_median": np.median(acceleration),
        "acceleration_nmse_worst": acceleration.max(),
        "learning_seconds_median": np.median(spent),
    }
    return {f"learned/{plant}/{model}": numbers}


def commands(controller: Controller, plant: DesktopPlant, t, y) -> tuple[Any, Any]:
    """Memories after every sample, and commands without the actuator's noise, along measurements."""

    def sample(memory, row):
        memory, u = controller.act(memory, *row)
        return memory, (memory, saturated(u, plant.hardware.lower, plant.hardware.upper))

    return jax.lax.scan(sample, controller.start, (t, y))[1]


def estimates(*, plant: str, model: str, starts: int = 1000, fewer: int = 100) -> Numbers:
    """Torques at the goal and errors of rates by differences, by filters tuned on 30 s of exploration, and exactly.

    The exact state is that of the time when a control acts. Differences and the extended filter by the known model have
    `starts` starts, others `fewer`.
    """
    desk, (near, last) = desktop_plant(plant), (f"estimates/{plant}/{model}", round(2.0 * RATE))
    recording, delay = recorded(desk, seconds=30.0, seed=0), desk.hardware.delay
    system, B = obtain(desk, model, recording, seed=0).dynamics, np.asarray(desk.scene.needs.actuation)
    process, law = from_log(system, recording, actuation=B, delay=delay).process, law_of(desk, system).law
    field = field_of(model_of_plant(desk), B)
    step = integrated(field, 1 / desk.rate, substeps=desk.substeps)

    def foreseeing(law):
        def act(u, t, x):
            u = saturated(law(step(x, u)), desk.hardware.lower, desk.hardware.upper)
            return u, u

        return Controller(jnp.zeros(1), act)

    def run(controller, x, key, seconds, *, sees):
        lab = desk.hardware._replace(encoder_step=0.0, sees_rates=True) if sees else desk.hardware
        settings: Any = {"rate": desk.rate, "controls": 1, "hardware": lab, "substeps": desk.substeps}
        motion = simulate(field, controller, x, seconds=seconds, key=key, **settings)
        return motion, *commands(controller, desk, motion.t[:-1], motion.y)

    def trial(controller, *, sees):
        def one(x, key):
            motion, _, asked = run(controller, x, key, SECONDS, sees=sees)
            u = asked[-last:, 0]
            flips = jnp.sum(jnp.sign(u[1:]) * jnp.sign(u[:-1]) < 0) / 2.0
            return motion.x[:, 1], jnp.sqrt(jnp.mean(u**2)), jnp.sqrt(jnp.mean(jnp.diff(u) ** 2)), flips

        return one

    estimators: dict[str, Callable[[Law], Controller]] = {
        "differences": by_differences(desk.layout),
        "extended": by_filter(desk.layout, process, delay=delay),
        "unscented": by_filter(desk.layout, process, delay=delay, make=unscented),
        "exact-state": foreseeing,
    }
    measured: dict[str, dict[str, float]] = {}
    for name, make in estimators.items():
        count = starts if model == "known" and name in ("differences", "extended") else fewer
        x = hanging_starts(count, 0, position=desk.position)
        angle, *of_torque = jax.jit(jax.vmap(trial(make(law), sees=name == "exact-state")))(
            x, jax.random.split(jax.random.key(0), count)
        )
        rms, change, flips = (float(np.median(values)) for values in of_torque)
        measured[f"{near}/{name}"] = {
            "success_share": outcomes(angle, rate=desk.rate).share,
            "torque_rms": rms,
            "torque_rms_ratio": rms / measured.get(f"{near}/differences", {"torque_rms": rms})["torque_rms"],
            "torque_change_rms": change,
            "reversals_per_second": flips,
        }

    @jax.jit
    def swung():
        start = hanging_starts(1, 7, position=desk.position)[0]
        motion, memories, asked = run(estimators["differences"](law), start, jax.random.key(7), 3.0, sees=False)
        # Controls act a sample after they are commanded.
        return motion.x[:-1, 2:], memories[0][2], motion.y, jnp.concatenate([jnp.zeros((1, 1)), asked[:-1]])

    true, by_difference, y, u = swung()
    rms_of = lambda qd: np.sqrt(np.mean((np.asarray(qd) - np.asarray(true)) ** 2, axis=0))  # noqa: E731
    prior = belief([0.0, np.pi, 0.0, 0.0], [1.0, np.pi, 1.0, 1.0])
    for name, make in {"extended": extended, "unscented": unscented}.items():
        error = rms_of(jax.jit(lambda make=make: filtered(make(process), prior, y, u)[0][:, 2:])())
        for joint, off, other in zip(("driven", "pole"), error, rms_of(by_difference), strict=True):
            measured[f"{near}/{name}"] |= {f"{joint}_rate_error": off, f"{joint}_rate_error_ratio": off / other}
    return measured
