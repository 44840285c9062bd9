"""A seven-axis arm that follows references in closed loop with known, identified and learned models.

The arm is that of the robot report (`robots.arm`) with dry friction, simulated in MuJoCo. The loop is in
`arm_loop`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.control import Gains, computed_torque, feed_forward, judged, trusted
from dln_jax.control.tracking import feedback
from dln_jax.data.encoders import smooth
from dln_jax.data.robots import Robot
from dln_jax.data.schema import Trajectories, from_arrays
from dln_jax.data.splits import Split, drawn, every, hold_out, select
from dln_jax.learning.dynamics import problem, suited_network
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import Adam, GaussNewton
from dln_jax.learning.friction import fit_friction
from dln_jax.learning.kinematics import Search, fit_tree
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees import tree_system
from dln_jax.metrics.errors import normalised_error
from dln_jax.models.serial_tree import make_serial_tree
from dln_jax.zoo.descriptions import build, describe
from scripts.reports.case import Findings, spread
from scripts.reports.control.arm_loop import Plant, Tracked, friction_of, in_mujoco, track
from scripts.reports.robots.arm import DAMPING, STIFFNESS, D, arm, logs, measured, motion
from scripts.reports.robots.known_kinematics import DECIMATE, LAWS, identified, rough
from scripts.reports.rows import Row

COMPUTED = Gains(np.full(D, 400.0), np.full(D, 40.0))
"""Gains of computed torque, 1/s² and 1/s: critically damped at 20 rad/s."""
AHEAD = Gains(STIFFNESS, DAMPING)
FEW = 2
"""Number of training motions of the deliberately bad network."""
STEPS = 30
"""Gauss-Newton steps of a network."""


class Effort(NamedTuple):
    """Size of the measurement."""

    seeds: int
    motions: int
    unseen: int
    samples: int | None
    """Samples of an unseen motion to track; all by default."""
    searched: Search


FULL = Effort(3, 15, 2, 4000, Search(seconds=40.0))
QUICK = Effort(1, 4, 1, 400, Search(starts=2, iterations=5))


def models(robot: Robot, seed: int, effort: Effort, random: np.random.Generator) -> dict[str, tuple[Dynamics, Any]]:
    """Models by name, with a test for out-of-distribution states or `None`.

    They are fitted to logs of PD control at 125 Hz with noisy encoders and torques (`robots.arm.measured`).
    """
    seen = smooth(from_arrays(measured(logs(robot, random, effort.motions), random))).data
    data = every(seen, DECIMATE)
    scale = fit_friction(rough(robot.tree), data, LAWS).shape["velocity_scale"]
    model, parameters = identified(robot.tree, data, scale)
    needs = robot.tree.needs._replace(friction=True)
    fitted = fit_tree(needs, data, velocity_scale=float(np.median(scale)), settings=effort.searched)
    learned = make_serial_tree(needs, velocity_scale=float(np.median(scale)))
    few = select(seen, np.unique(seen.trajectory)[: FEW + 1])
    return {
        "known": (dynamics(tree_system(robot.tree, friction_of(robot))), None),
        "identified": (dynamics(model.energies(parameters)), None),
        "learned-tree": (dynamics(learned.energies(fitted.parameters)), None),
        "network": (network(robot, seen, seed, float(np.median(scale)), effort), within(seen)),
        "bad-network": (network(robot, few, seed, float(np.median(scale)), effort), within(few)),
    }


def network(robot: Robot, data: Trajectories, seed: int, scale: float, effort: Effort) -> Dynamics:
    """A structured DeLaN with joint friction and the library's default size for the data, trained by the library."""
    train, validation = hold_out(data, 0.1, seed)
    needs = robot.tree.needs._replace(friction=False, joint_friction=LAWS, velocity_scale=scale)
    chosen = suited_network(needs, train)
    model = build(describe("structured-delan", precision="f64", needs=needs, **chosen.keywords))
    if chosen.samples is not None:
        train = drawn(train, chosen.samples, seed)
    steps = 2 if effort is QUICK else STEPS
    optimiser = GaussNewton(steps=steps) if chosen.optimizer == "gauss-newton" else Adam(steps=steps * 100)
    training = fit(problem(model, Split(train, validation, validation), seeds=seed), optimiser)
    return dynamics(model.energies(training.parameters))


def within(data: Trajectories) -> Callable[..., Any]:
    """(q, qd, qdd) -> whether an angle or a rate lies outside the range of the data."""
    states = np.concatenate([data.q, data.qd], axis=1)
    low, high = states.min(axis=0), states.max(axis=0)

    def out_of_distribution(q: Any, qd: Any, qdd: Any) -> Any:
        x = jnp.concatenate([q, qd])
        return jnp.any((x < low) | (x > high))

    return out_of_distribution


def laws(known: dict[str, tuple[Dynamics, Any]], held_out: Trajectories) -> dict[str, Any]:
    """Control laws by name, feedback alone first. `judged` also requires that the model explains held-out motions."""
    by_name: dict[str, Any] = {"feedback-alone": lambda q, qd, now: feedback(AHEAD, q, qd, now)}
    for name, (model, flag) in known.items():
        ahead, computed = feed_forward(model, AHEAD), computed_torque(model, COMPUTED)
        by_name |= {f"feed-forward/{name}": ahead, f"computed-torque/{name}": computed}
        if flag is not None:
            by_name[f"trusted/{name}"] = trusted(model, computed, ahead, out_of_distribution=flag)
            usable = judged(model, held_out).usable
            by_name[f"judged/{name}"] = trusted(model, computed, ahead, out_of_distribution=flag, usable=usable)
    return by_name


def tracking(quick: bool) -> Findings:
    """Rms errors, mrad, by law and model over seeds of the data and unseen motions; failures count separately."""
    effort, robot = QUICK if quick else FULL, arm(coulomb=True)
    plant = in_mujoco(robot)
    by_law: dict[str, list[Tracked]] = {}
    errors: dict[str, list[float]] = {}
    for seed in range(effort.seeds):
        of_models, of_laws = one_seed(robot, plant, seed, effort)
        for name, nmse in of_models.items():
            errors.setdefault(name, []).append(nmse)
        for name, runs in of_laws.items():
            by_law.setdefault(name, []).extend(runs)
    rows = [Row(f"tracking/model/{name}", "nmse", float(np.median(values))) for name, values in errors.items()]
    return Findings([*rows, *(row for name, runs in by_law.items() for row in rows_of(name, runs))])


def one_seed(
    robot: Robot, plant: Plant, seed: int, effort: Effort
) -> tuple[dict[str, float], dict[str, list[Tracked]]]:
    """nMSE of the models on an unseen motion, and tracking results of the laws on other unseen motions."""
    random = np.random.default_rng(seed)
    known = models(robot, seed, effort, random)
    wanted = [motion(random) for _ in range(effort.unseen)]
    test, errors = logs(robot, random, 1), {}
    other = np.random.default_rng([seed, 1])
    held_out = smooth(from_arrays(measured(logs(robot, other, 1), other))).data
    for name, (model, _) in known.items():
        tau = jax.jit(jax.vmap(model.inverse_dynamics))(test.q, test.qd, test.qdd)
        errors[name] = float(np.mean(normalised_error(np.asarray(tau), test.tau)))
    return errors, {
        name: [track(plant, law, motion, effort.samples) for motion in wanted]
        for name, law in laws(known, held_out).items()
    }


def rows_of(name: str, runs: list[Tracked]) -> list[Row]:
    """Median and worst rms error over finite runs, and the number of runs that failed."""
    case, rms = f"tracking/{name}", np.array([run.rms for run in runs])
    sound = rms[np.isfinite(rms)]
    rows = spread(case, "rms_mrad", sound if len(sound) else np.inf, "mrad")
    rows.append(Row(case, "failures", float(len(rms) - len(sound)), expected=f"of {len(rms)} runs"))
    if name.startswith(("trusted", "judged")):
        rows.append(Row(case, "share_trusted", float(np.mean([run.trusted for run in runs]))))
    return rows
