"""Torque errors on unseen letters, against the number of training letters and at other speeds than in training.

The offline experiments of Lutter, Ritter and Peters (2019, arXiv:1907.04490). All models are fitted to the same samples
of the same letters with the same number of iterations, and selected by the same held-out samples. A letter at s times
its speed is the motion (q, s qd, s² qdd), with the torque of the exact plant.
"""

from functools import partial
from pathlib import Path

import jax
import numpy as np

from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import every, label_indices, select
from dln_jax.learning.online import appended, empty_replay
from dln_jax.mechanics import closed_form
from dln_jax.metrics.errors import mean_square
from dln_jax.models.model import Parameters
from dln_jax.scenes.datasets.generators import CHARACTERS_TEST
from dln_jax.scenes.pendulums import two_link_arm
from dln_jax.types import InputError
from scripts.reports.arm.data import letters, partition_labels
from scripts.reports.arm.learners import IDENTIFIED, Learner, learners
from scripts.reports.run import Numbers

COUNTS, SPEEDS = (1, 2, 3, 5, 8), (0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0)
THINNED = 2
"""Every second sample is fitted, 12.5 per second; all samples of the test letters are evaluated."""

_exact = jax.jit(jax.vmap(partial(closed_form.inverse_dynamics, two_link_arm().closed_form)))


def measure_letters(
    by: str, *, data: Path | None = None, test: tuple[str, ...] = CHARACTERS_TEST, splits: int = 3, seeds: int = 2,
    rounds: int = 8,
) -> Numbers:  # fmt: skip
    """Test errors of all models by the number of "letters" or by "speeds": median and worst over splits and seeds.

    Args:
        test: the first set of test letters; other splits are disjoint groups of the same size.
        rounds: rounds of five Levenberg-Marquardt iterations.
    """
    written = letters(data)
    if not np.allclose(faster(written, 1.0).tau, written.tau, atol=1e-6):
        raise InputError(
            "tau is not that of the published two-link arm, whose torques at other speeds are to be predicted; "
            "give letters of that arm, or measure others with --only published,online"
        )
    most = len(np.unique(written.trajectory)) - len(test)
    settings = {f"{count}-letters": (count, 1.0) for count in (*(count for count in COUNTS if count < most), most)}
    if by == "speeds":
        settings = {f"speed-{speed:g}": (most, speed) for speed in SPEEDS}
    groups = partition_labels(written, max(2, len(np.unique(written.trajectory)) // len(test)))
    tests = [list(test), *(group[: len(test)] for group in groups if set(group) != set(test))][:splits]
    name, known = "embedded-letters" if data is None else data.stem, learners(rounds=rounds)
    values: dict[tuple[str, str], list[float]] = {}
    for labels in tests:
        held_out = select(written, label_indices(written, labels))
        for seed in range(seeds):
            fits = {
                (model, count): fitted(learner, written, labels, count, seed)
                for model, learner in known.items()
                for count in {count for count, _ in settings.values()}
            }
            for setting, (count, speed) in settings.items():
                moved = faster(held_out, speed)
                for model, learner in known.items():
                    parameters, seen = fits[model, count]
                    torques = np.asarray(learner.torques(parameters, moved.q, moved.qd, moved.qdd))
                    values.setdefault((f"{model}/{name}/{setting}", "torque_mse"), []).append(
                        mean_square(torques - moved.tau)
                    )
                now, seen = states(moved), fits[IDENTIFIED, count][1]
                outside = ((now < seen.min(axis=0)) | (now > seen.max(axis=0))).any(axis=1)
                for quantity, value in {
                    "torque_mean_square": mean_square(moved.tau),
                    "share_outside_training": float(outside.mean()),
                }.items():
                    values.setdefault((f"data/{name}/{setting}", quantity), []).append(value)
    numbers: dict[str, dict[str, float]] = {}
    for (case, quantity), measured in values.items():
        ends = ("_median", "_worst") if quantity == "torque_mse" else ("",)
        for end, of in zip(ends, (np.median, np.max), strict=False):
            numbers.setdefault(case, {})[quantity + end] = float(of(measured))
    return numbers


def fitted(
    learner: Learner, data: Trajectories, test: list[str], count: int, seed: int
) -> tuple[Parameters, np.ndarray]:
    """Fits a model to `count` letters without those of the test; returns its parameters and the states that it saw.

    Smaller sets of letters are subsets of larger ones.
    """
    present = np.setdiff1d(np.unique(data.trajectory), label_indices(data, test))
    chosen = np.random.default_rng([seed, 1]).permutation(present)[:count].tolist()
    thin = every(data, THINNED)
    replay = empty_replay(len(thin.t), data.degrees_of_freedom)
    for index in chosen:
        letter = select(thin, [index])
        replay = appended(replay, letter.q, letter.qd, letter.qdd, letter.tau)
    return learner.refit(learner.start(seed), replay), states(select(thin, chosen))


def states(data: Trajectories) -> np.ndarray:
    """The states (q, qd, qdd) of all samples, [N, 3 d]."""
    return np.hstack([data.q, data.qd, data.qdd])


def faster(data: Trajectories, speed: float) -> Trajectories:
    """The same paths at `speed` times their speed, with the torques of the exact plant."""
    q, qd, qdd = data.q, speed * data.qd, speed**2 * data.qdd
    return data._replace(
        t=data.t / speed, qd=qd, qdd=qdd, tau=np.asarray(_exact(q, qd, qdd)), p=None, pd=None,
        tau_inertial=None, tau_coriolis=None, tau_gravity=None,
    )  # fmt: skip
