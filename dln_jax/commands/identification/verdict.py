"""Judges an identified robot: its torques on held-out motions, and its physical plausibility."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.data.encoders.sampling import torque_noise
from dln_jax.data.log import Log
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import every
from dln_jax.identification.identify import Identification
from dln_jax.identification.rigid_tree import MOST, shared_motor
from dln_jax.learning.linear import parameters_of
from dln_jax.metrics.errors import normalised_error
from dln_jax.metrics.verdict import WORSE, Verdict, held_out, judge, verdict_metrics, worst
from dln_jax.models.model import Parameters
from dln_jax.zoo.descriptions import Description

HEAVIER, MUCH_HEAVIER = 5.0, 50.0
"""Factors by which the bodies' torques may differ from those of the robot's file: beyond the first the fit is doubtful,
beyond the second refused. Payloads and rough files stay below; wrong units (N mm, mN m) do not. A single joint, where a
payload counts for more, is doubtful beyond the second."""
IMPOSSIBLE = 0.1
"""A physically consistent robot is ruled out if its mean nMSE exceeds the nMSE of least squares by this."""
SLIGHT = 1e-3
"""Torques of bodies below this fraction of those in the strongest joint are not compared."""
COUNTS = 0.02
"""Friction is judged if its standard deviation exceeds this fraction of the torque's."""
FAST = 0.9
"""Quantile of a joint's speed that must exceed the velocity scale of its friction."""
SPIKE = 10.0
"""A spike deviates from the median of five neighbours by more than this many typical deviations."""
SPIKES = 5e-4
"""Spikes are reported if their fraction is larger."""


Predict = Callable[[Parameters, Trajectories], tuple[np.ndarray, np.ndarray]]
"""(parameters, data) -> torque and friction [N, d]."""


def judge_robot(
    solution: Identification,
    known: Parameters,
    description: Description,
    predict: Predict,
    train: Trajectories,
    test: Trajectories,
    torques: dict[str, np.ndarray],
    log: Log,
    *,
    robust: bool,
    whole: bool,
) -> tuple[Verdict, dict[str, float | int]]:
    """The verdict on an identified robot, and its entries of metrics.json.

    Args:
        known: parameters in the robot's file.
        torques: torques on the held-out motions [N, d], by "file", "least_squares" and "identified".
        log: the log with its robot; its faults count, and the noise of its torques is estimated if it states none.
        robust: whether spikes in held-out samples are ignored.
        whole: whether a fit to motions predicts the held-out ones to their ends.
    """
    assert log.robot is not None
    names, fitted, d = log.robot.tree.names, torques["identified"], test.degrees_of_freedom
    noise = torque_noise(train) if log.torque_noise is None else log.torque_noise
    rows = ~spikes(test.tau).any(axis=1) if robust else np.ones(len(test.t), bool)
    errors = held_out(fitted[rows], test.tau[rows], noise=noise, file=torques["file"][rows])
    by_torques = judge(errors, names)
    if whole and by_torques.level == "doubtful":
        # A fit to motions may deviate from filtered torques by more than their noise: the filter moves them too.
        by_torques = judge(errors._replace(noise=None), names)
    mine = parameters_of(solution.theta, known)
    still = np.zeros_like(test.q)
    friction = predict(mine, test._replace(q=still, qdd=still))[1]
    scales = description["velocity_scale"]
    stated = not isinstance(scales, list) or not {"coulomb", "stribeck"} & set(description["needs"]["joint_friction"])
    alone = (jax.tree.map(jnp.zeros_like, theta)._replace(inertias=theta.inertias) for theta in (mine, known))
    bodies = [predict(theta, test)[0] for theta in alone]
    verdict = worst(
        by_torques,
        consistent_verdict(solution, fitted, torques["least_squares"], test.tau),
        friction_verdict(names, test.qd, test.tau, friction, None if stated else np.array(scales)),
        weight_verdict(*bodies),
        causes=log.faults,
    )
    if verdict.level != "good" and description["motors"] is None:
        thin = every(train, -(-len(train.t) // MOST))
        motor = shared_motor(thin.tau - predict(mine, thin)[0], thin.qd)
        if motor is not None:
            joint, other, ratio, explained = motor
            S = np.eye(d)
            S[joint, other] = ratio
            rows = ";".join(",".join(f"{entry:g}" for entry in row) for row in S)
            remedy = (
                f"friction of a motor that turns with {names[joint]} and {ratio:g} times {names[other]} would explain "
                f"{explained:.0%} of the residual of both: try --motors '{rows}'"
            )
            verdict = verdict._replace(remedy=f"{remedy}; else {verdict.remedy}")
    share = spikes(train.tau).mean(axis=0)
    if verdict.level != "good" and not robust and share.max() > SPIKES:
        which = ", ".join(names[k] for k in range(d) if share[k] > SPIKES)
        reason = f"{share.max():.2%} of the torques of {which} are spikes: {verdict.reason}"
        verdict = Verdict(verdict.level, reason, f"give --robust; else {verdict.remedy}")
    return verdict, verdict_metrics(errors, verdict)


def spikes(tau: Float[np.ndarray, "N d"]) -> np.ndarray:
    """Mask of torques [N, d] that are isolated outliers (Hampel's identifier, a window of five)."""
    padded = np.pad(tau, ((2, 2), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 5, axis=0)
    away = np.abs(tau - np.median(windows, axis=-1))
    usual = np.maximum(1.4826 * np.median(away, axis=0), 1e-3 * tau.std(axis=0))
    # Jumps of the motion, such as those of dry friction, are not isolated and never exceed the torque's range.
    size = np.median(np.abs(tau - np.median(tau, axis=0)), axis=0)
    return away > np.maximum(SPIKE * usual, 2 * size)


def consistent_verdict(solution: Identification, fitted: np.ndarray, free: np.ndarray, tau: np.ndarray) -> Verdict:
    """Whether physically consistent bodies explain the torques [N, d] as well as unconstrained least squares."""
    mine, least = (np.nanmean(normalised_error(torque, tau)) for torque in (fitted, free))
    if solution.consistent is None or mine <= 2 * least + WORSE:
        return Verdict("good", "")
    level = "refused" if mine > least + IMPOSSIBLE else "doubtful"
    reason = f"physically consistent parameters have an nMSE of {mine:.3g}, unconstrained least squares {least:.3g}"
    if not solution.consistent.converged:
        reason += f", not converged after {solution.consistent.iterations} iterations"
    remedy = "check the signs and units of tau and the robot's file: no robot has such torques"
    return Verdict(level, reason, remedy)


def friction_verdict(
    names: tuple[str, ...],
    qd: Float[np.ndarray, "N d"],
    tau: Float[np.ndarray, "N d"],
    friction: Float[np.ndarray, "N d"],
    scales: Float[np.ndarray, " d"] | None,
) -> Verdict:
    """Whether friction dissipates energy, and whether the joints reach the fitted velocity scales."""
    every, counts = [Verdict("good", "")], np.std(friction, axis=0) > COUNTS * np.std(tau, axis=0)
    power = np.mean(qd * (friction - friction.mean(axis=0)), axis=0)
    for k in np.flatnonzero(counts & (power < 0)):
        reason = f"friction of {names[k]} adds energy, {-power[k]:.3g} W on average"
        every.append(Verdict("refused", reason, "check the signs of tau and qd"))
    if scales is not None:
        for k in np.flatnonzero(counts & (scales > np.quantile(np.abs(qd), FAST, axis=0))):
            reason = f"{names[k]} hardly reaches {scales[k]:.3g}/s, the velocity scale of its dry friction"
            every.append(Verdict("doubtful", reason, "state it (--velocity-scale 0.05), or record faster motions"))
    return worst(*every)


def weight_verdict(mine: Float[np.ndarray, "N d"], file: Float[np.ndarray, "N d"]) -> Verdict:
    """Whether the torques of the bodies are of the same magnitude as those of the robot's file, in every joint."""
    sizes = np.sqrt(np.mean(np.square([mine, file]), axis=1))
    slight = SLIGHT * sizes[1].max()
    there = sizes[1] > slight
    if not there.any():
        return Verdict("good", "")
    # The file may state nothing of a joint that hardly counts, such as the mass of a flange.
    factors = np.divide(*(sizes + slight))
    off, factor = np.maximum(factors, 1 / factors), np.median(np.divide(*sizes[:, there]))
    joint, typical = int(np.argmax(off)), max(factor, 1 / max(factor, SLIGHT))
    if typical <= HEAVIER and off[joint] <= MUCH_HEAVIER:
        return Verdict("good", "")
    reason = (
        f"the identified bodies take {factor:.3g} times the torques of those in the robot's file, and in joint "
        f"{joint + 1} {factors[joint]:.3g} times"
    )
    remedy = "check the unit of tau (N m) and its side of the gears, or correct the masses in the file"
    return Verdict("refused" if typical > MUCH_HEAVIER else "doubtful", reason, remedy)
