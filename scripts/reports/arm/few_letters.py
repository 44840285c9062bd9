"""Torque errors on unseen letters, against the number of training letters and at other speeds than in training.

The offline experiments of Lutter, Ritter and Peters (2019, arXiv:1907.04490). All models are fitted to the same samples
of the same letters with the same number of iterations, and selected by the same held-out samples. A letter at s times
its speed is the motion (q, s qd, s² qdd), with the torque of the exact plant.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import every, label_indices, select
from dln_jax.learning.online import appended, empty_replay
from dln_jax.mechanics import closed_form
from dln_jax.metrics.errors import mean_square
from dln_jax.models.model import Parameters
from dln_jax.scenes.pendulums import two_link_arm
from dln_jax.types import InputError
from scripts.reports.arm.rivals import IDENTIFIED, Rival, rivals, size
from scripts.reports.case import Case, Findings, spread
from scripts.reports.parts import partition_labels
from scripts.reports.rows import Row

COUNTS, SPEEDS = (1, 2, 3, 5, 8), (0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0)
ZERO, OUT_OF_DISTRIBUTION = "torque_mean_square", "share_outside_training"
THINNED = 2
"""Every second sample is fitted, 12.5 per second; all samples of the test letters are evaluated."""

_exact = jax.jit(jax.vmap(partial(closed_form.inverse_dynamics, two_link_arm().closed_form)))


class Effort(NamedTuple):
    """Numbers of splits, seeds and iterations."""

    splits: int = 3
    """Number of sets of test letters; the published set comes first."""
    seeds: int = 2
    """Number of seeds per split; a seed sets the initial parameters and the order of the training letters."""
    rounds: int = 8
    """Number of rounds of five Levenberg-Marquardt iterations."""


QUICK = Effort(splits=1, seeds=1, rounds=2)


class Fit(NamedTuple):
    """A rival fitted to some letters."""

    parameters: Parameters
    low: Float[np.ndarray, " n"]
    high: Float[np.ndarray, " n"]
    """Range of the fitted (q, qd, qdd); n = 6."""


Settings = Mapping[str, tuple[int, float]]
"""Number of training letters and speed, by name."""


def against_letters(name: str, data: Trajectories, test: Sequence[str], *, quick: bool = False) -> Case:
    """Errors against the number of training letters; `name` names the data, `test` is the first set of test letters."""
    most = _training_letters(data, test)
    counts = {f"{count}-letters": (count, 1.0) for count in (*(count for count in COUNTS if count < most), most)}
    return _case(f"{name}/letters", data, test, counts, quick)


def at_speeds(name: str, data: Trajectories, test: Sequence[str], *, quick: bool = False) -> Case:
    """Errors at other speeds of the test letters, after training on all other letters; arguments as above."""
    speeds = {f"speed-{speed:g}": (_training_letters(data, test), speed) for speed in SPEEDS}
    return _case(f"{name}/speeds", data, test, speeds, quick)


def _training_letters(data: Trajectories, test: Sequence[str]) -> int:
    return len(np.unique(data.trajectory)) - len(test)


def _case(name: str, data: Trajectories, test: Sequence[str], settings: Settings, quick: bool) -> Case:
    if not np.allclose(faster(data, 1.0).tau, data.tau, atol=1e-6):
        raise InputError(
            "tau is not that of the published two-link arm, whose torques at other speeds are to be predicted; "
            "give letters of that arm, or leave letters and speeds out (--only published,online)"
        )
    effort = QUICK if quick else Effort()
    run = partial(measure, name.split("/")[0], data, test_sets(data, test, effort.splits), effort, settings)
    return Case(name, run)


def test_sets(data: Trajectories, test: Sequence[str], splits: int) -> list[list[str]]:
    """The test letters, then disjoint groups of the same size."""
    parts = max(2, len(np.unique(data.trajectory)) // len(test))
    groups = [group[: len(test)] for group in partition_labels(data, parts) if set(group) != set(test)]
    return [list(test), *groups][:splits]


def measure(
    name: str, data: Trajectories, splits: Sequence[Sequence[str]], effort: Effort, settings: Settings
) -> Findings:
    """Test errors of all rivals in all settings: median and worst over splits and seeds."""
    known, runs = rivals(rounds=effort.rounds), []
    for test in splits:
        for seed in range(effort.seeds):
            runs.append(one_run(known, data, test, seed, settings))
    rows = [Row(f"{model}/{name}", "parameters", float(size(rival))) for model, rival in known.items()]
    for model in known:
        for setting in settings:
            values = [run[setting][model] for run in runs]
            rows += spread(f"{model}/{name}/{setting}", "torque_mse", values, "N^2 m^2")
    for setting in settings:
        for quantity, unit in {ZERO: "N^2 m^2", OUT_OF_DISTRIBUTION: "1"}.items():
            median = float(np.median([run[setting][quantity] for run in runs]))
            rows.append(Row(f"data/{name}/{setting}", quantity, median, unit))
    return Findings(rows)


def one_run(
    known: Mapping[str, Rival], data: Trajectories, test: Sequence[str], seed: int, settings: Settings
) -> dict[str, dict[str, float]]:
    """Torque MSE of the rivals, mean square of the torque, and share of out-of-distribution samples, by setting."""
    held_out, fits = select(data, label_indices(data, test)), {}
    numbers: dict[str, dict[str, float]] = {}
    for setting, (count, speed) in settings.items():
        if count not in fits:
            fits[count] = {name: fitted(rival, data, test, count, seed) for name, rival in known.items()}
        letters = faster(held_out, speed)
        numbers[setting] = {
            **{name: torque_mse(known[name], fit.parameters, letters) for name, fit in fits[count].items()},
            ZERO: mean_square(letters.tau),
            OUT_OF_DISTRIBUTION: share_out_of_distribution(fits[count][IDENTIFIED], letters),
        }
    return numbers


def fitted(rival: Rival, data: Trajectories, test: Sequence[str], count: int, seed: int) -> Fit:
    """Fits a rival to `count` letters without those of the test; smaller sets are subsets of larger ones."""
    letters = np.setdiff1d(np.unique(data.trajectory), label_indices(data, test))
    chosen = np.random.default_rng([seed, 1]).permutation(letters)[:count].tolist()
    thin = every(data, THINNED)
    replay = empty_replay(len(thin.t), data.degrees_of_freedom)
    for index in chosen:
        letter = select(thin, [index])
        replay = appended(replay, letter.q, letter.qd, letter.qdd, letter.tau)
    parameters = rival.refit(rival.start(seed), replay)
    seen = states(select(thin, chosen))
    return Fit(parameters, seen.min(axis=0), seen.max(axis=0))


def states(data: Trajectories) -> Float[np.ndarray, "N n"]:
    """The states (q, qd, qdd) of all samples."""
    return np.hstack([data.q, data.qd, data.qdd])


def faster(data: Trajectories, speed: float) -> Trajectories:
    """The same paths at `speed` times their speed, with the torques of the exact plant."""
    q, qd, qdd = data.q, speed * data.qd, speed**2 * data.qdd
    return data._replace(
        t=data.t / speed, qd=qd, qdd=qdd, tau=np.asarray(_exact(q, qd, qdd)), p=None, pd=None,
        tau_inertial=None, tau_coriolis=None, tau_gravity=None,
    )  # fmt: skip


def torque_mse(rival: Rival, parameters: Parameters, data: Trajectories) -> float:
    """Mean squared torque error, summed over joints."""
    return mean_square(np.asarray(rival.torques(parameters, data.q, data.qd, data.qdd)) - data.tau)


def share_out_of_distribution(fit: Fit, data: Trajectories) -> float:
    """Share of samples with an angle, a rate or an acceleration outside the fitted range."""
    now = states(data)
    return float(np.mean(((now < fit.low) | (now > fit.high)).any(axis=1)))
