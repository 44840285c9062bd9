"""Judges an identified robot: its torques on held-out motions, and its physical plausibility."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.data.encoders.sampling import torque_noise
from dln_jax.data.splits import every
from dln_jax.identification.identify import Identification, parameters_of
from dln_jax.identification.shared_motors import MOST, shared_motor
from dln_jax.metrics.errors import normalised_error
from dln_jax.metrics.verdict import WORSE, Verdict, held_out, judge, verdict_metrics, worst
from dln_jax.models.trees import RigidTreeParameters
from dln_jax.training.identification.additions import Predict
from dln_jax.training.identification.task import Case

HEAVIER, MUCH_HEAVIER = 5.0, 50.0
"""Factors by which the bodies' torques may differ from those of the robot's file: beyond the first the fit is doubtful,
beyond the second refused. Payloads and rough files stay below; wrong units (N mm, mN m) do not. A single joint, where a
payload counts for more, is doubtful beyond the second."""
IMPOSSIBLE = 0.1
"""A physically consistent robot is ruled out if its mean nMSE exceeds that of least squares by this."""
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


def judged(
    case: Case, solution: Identification, predict: Predict, torques: dict[str, np.ndarray], kept: str,
    *, robust: bool, moves: bool,
) -> tuple[Verdict, dict[str, float | int]]:  # fmt: skip
    """The verdict on an identified robot, and its entries of metrics.json.

    Args:
        predict: torques by parameters.
        torques: torques on the held-out motions [N, d], by "file", "least_squares" and `kept`.
        kept: key of the torques of the model that the run keeps.
        robust: whether spikes in held-out samples are ignored.
        moves: whether a fit to motions predicts the held-out ones to their ends.
    """
    test, d = case.sets.test, case.sets.test.degrees_of_freedom
    peaks = spikes(test.tau)
    rows = ~peaks.any(axis=1) if robust else np.ones(len(test.t), bool)
    noise = case.filtered_noise if case.noise is None else case.noise
    noise = torque_noise(case.sets.train) if noise is None else noise
    errors = held_out(torques[kept][rows], test.tau[rows], noise=noise, file=torques["file"][rows])
    by_torques = judge(errors, case.names)
    if moves and by_torques.level == "doubtful":
        # A fit to motions may deviate from filtered torques by more than their noise: the filter moves them too.
        by_torques = judge(errors._replace(noise=None), case.names)
    verdicts = [by_torques, existing(solution, torques, kept, test.tau)]
    mine = parameters_of(solution.theta, case.known)
    still = np.zeros_like(test.q)
    friction = predict(mine, still, test.qd, still).friction
    scales = case.description.get("velocity_scale") if {"coulomb", "stribeck"} & set(case.laws) else None
    fitted = np.array(scales) if isinstance(scales, list) else None
    verdicts += [friction_verdict(case.names, test.qd, test.tau, friction, fitted)]
    bodies = [predict(without_joints(theta), test.q, test.qd, test.qdd).torque for theta in (mine, case.known)]
    verdicts += [weight_verdict(*bodies)]
    verdict = worst(*verdicts, causes=case.causes)
    if verdict.level != "good" and case.description["motors"] is None:
        train = every(case.sets.train, -(-len(case.sets.train.t) // MOST))
        motor = shared_motor(train.tau - predict(mine, train.q, train.qd, train.qdd).torque, train.qd)
        if motor is not None:
            names = [case.names[k] for k in (motor.joint, motor.other)]
            rows = ";".join(",".join(f"{entry:g}" for entry in row) for row in motor.rates(d))
            remedy = (
                f"friction of a motor that turns with {names[0]} and {motor.ratio:g} times {names[1]} would explain "
                f"{motor.share:.0%} of what is left in both: try --motors '{rows}'"
            )
            verdict = Verdict(verdict.level, verdict.reason, f"{remedy}; else {verdict.remedy}")
    share = spikes(case.sets.train.tau).mean(axis=0)
    if verdict.level != "good" and not robust and share.max() > SPIKES:
        which = ", ".join(case.names[k] for k in range(d) if share[k] > SPIKES)
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


def existing(solution: Identification, torques: dict[str, np.ndarray], kept: str, tau: np.ndarray) -> Verdict:
    """Whether physically consistent bodies explain the torques as well as unconstrained least squares."""
    if solution.consistent is None:
        return Verdict("good", "")
    mine, free = (np.nanmean(normalised_error(torques[name], tau)) for name in (kept, "least_squares"))
    if mine <= 2 * free + WORSE:
        return Verdict("good", "")
    level = "refused" if mine > free + IMPOSSIBLE else "doubtful"
    reason = f"physically consistent bodies have an nMSE of {mine:.3g}, least squares without that bound {free:.3g}"
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
        reason = f"friction of {names[k]} drives it: {-power[k]:.3g} W on average"
        every.append(Verdict("refused", reason, "check the signs of tau and qd; keep --consistent"))
    if scales is not None:
        for k in np.flatnonzero(counts & (scales > np.quantile(np.abs(qd), FAST, axis=0))):
            reason = f"{names[k]} hardly reaches {scales[k]:.3g}/s, the velocity scale of its dry friction"
            every.append(Verdict("doubtful", reason, "state it (--velocity-scale 0.05), or record faster motions"))
    return worst(*every)


def without_joints(parameters: RigidTreeParameters) -> RigidTreeParameters:
    """Parameters of the bodies alone, without armature and friction."""
    return jax.tree.map(jnp.zeros_like, parameters)._replace(inertias=parameters.inertias)


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
        f"the bodies take {factor:.3g} times the torques of those in the robot's file, in joint {joint + 1} "
        f"{factors[joint]:.3g} times"
    )
    remedy = "check the unit of tau (N m) and its side of the gears, or correct the masses in the file"
    return Verdict("refused" if typical > MUCH_HEAVIER else "doubtful", reason, remedy)
