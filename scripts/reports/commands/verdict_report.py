"""Measure the verdict on fitted robots: sound logs of random arms must be good, spoiled ones refused.

Each log is identified as the command identify does, from a robot's file with rough masses; logs of two joints are also
fitted by a tree of unknown frames, as train_delan does without a file. Prints one table (case, quantity, expected,
value, unit, to reach, pass) and writes report.json.
"""

import contextlib
import io
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from dln_jax.cli.commands import train_delan
from dln_jax.cli.options import Folder
from dln_jax.cli.stored_arguments import command_folder
from dln_jax.data.mjcf import mjcf
from dln_jax.files import read_json
from dln_jax.metrics.verdict import LEVELS, FitRefused
from dln_jax.training.identification.run import run
from dln_jax.training.identification.task import Options
from dln_jax.types import InputError, require_positive, require_seed
from scripts.reports.case import Case, Findings, measure_and_publish
from scripts.reports.robots.faulty_logs import FAULTS, Arrays, Fault, random_arm, rough_file, sound_log
from scripts.reports.rows import Row, expect

JOINTS = (2, 3, 4, 6)
"""Numbers of joints of successive arms."""
NOISES = (0.0, 0.01, 0.05, 0.1)
"""Standard deviations of the torque noise, relative to the torque's own."""


LEARNED_JOINTS = 2
LEARNED_FAULTS = ("flipped-sign", "swapped-columns", "torques-of-another-motion", "rates-exchanged", "spikes")
"""Faults of the logs that trees with unknown joint frames are fitted to."""


@dataclass(frozen=True)
class Arguments(Folder):
    """How many logs."""

    logs: int = 6
    """Sound ones, each of an arm of its own; each is then spoiled in every way."""
    learned: int = 2
    """Of the same for trees of unknown frames; a fit takes a minute or two."""
    seed: int = 100
    """Of the first arm; thresholds were chosen by seeds below 100."""


def main(given: Arguments) -> None:
    """Measures, prints and writes."""
    require_positive(logs=given.logs)
    require_seed(given.seed)
    with command_folder(given, "verdicts") as folder:
        cases = [case(f"identify/{name}", given.logs, identified_arm, given.seed) for name in ("sound", *FAULTS)]
        if given.learned:
            names = ("sound", *LEARNED_FAULTS)
            cases += [case(f"learned-tree/{name}", given.learned, learned_tree, given.seed) for name in names]
        measure_and_publish(folder, cases, dtype="float64", seeds=[given.seed, given.seed + given.logs - 1])


def case(name: str, logs: int, verdict_of: Callable[[int, Fault | None], str], seed: int) -> Case:
    """A case with the verdicts on logs of one kind; the kind is the last part of the name."""
    fault = FAULTS.get(name.rpartition("/")[2])
    return Case(name, partial(findings, name, fault, logs, verdict_of, seed))


def findings(
    case: str, fault: Fault | None, logs: int, verdict_of: Callable[[int, Fault | None], str], seed: int
) -> Findings:
    """Shares of the verdicts over the logs."""
    counts = Counter(verdict_of(seed + number, fault) for number in range(logs))
    shares = {level: counts[level] / logs for level in LEVELS}
    rows = [Row(case, f"{level}_share", shares[level]) for level in LEVELS]
    told_frames = case.startswith("identify")
    if fault is None and told_frames:
        rows[0] = expect(case, "good_share", "sound logs are good", shares["good"], 1.0, at_least=True)
    elif fault is None:  # the arms' friction has offsets, which such a tree does not model
        rows[2] = expect(case, "refused_share", "sound logs are not refused", shares["refused"], 0.0)
    elif fault.level == "refused" and told_frames:
        rows[2] = expect(case, "refused_share", "ruined", shares["refused"], 1.0, at_least=True)
    else:
        rows[0] = expect(case, "good_share", "spoiled: at least doubtful", shares["good"], 0.0)
    return Findings(rows)


def log_of(seed: int, joints: int, fault: Fault | None) -> tuple[Arm, Arrays]:
    """A random arm and its log, with the fault if there is one."""
    arm = random_arm(seed, joints)
    log = sound_log(arm, seed, NOISES[(3 * seed + seed // len(JOINTS)) % len(NOISES)])
    return arm, log if fault is None else fault.spoil(log, np.random.default_rng([seed, 3]))


def identified_arm(seed: int, fault: Fault | None) -> str:
    """The verdict of `identify` on one log."""
    arm, log = log_of(seed, JOINTS[seed % len(JOINTS)], fault)
    with tempfile.TemporaryDirectory(prefix="dln_jax-") as name:
        folder = Path(name)
        (folder / "arm.xml").write_text(mjcf(rough_file(arm, seed)))
        return identified(folder, log, accepted=fault is not None)["level"]


def learned_tree(seed: int, fault: Fault | None) -> str:
    """The verdict of `train_delan --model learned-tree` on one log, without a robot's file."""
    _, log = log_of(seed, LEARNED_JOINTS, fault)
    with tempfile.TemporaryDirectory(prefix="dln_jax-") as name:
        folder = Path(name)
        np.savez(folder / "log.npz", **log)
        options = train_delan.Arguments(
            data=folder / "log.npz", out=folder / "run", model="learned-tree", uncertainty=False, figures=False,
            low_latency=False, accept_log=fault is not None,
        )  # fmt: skip
        return _verdict(folder / "run", lambda: train_delan.main(options))["level"]


def identified(folder: Path, log: Arrays, *, accepted: bool) -> dict[str, str]:
    """The verdict on a log with reason and remedy, identified from the robot file arm.xml in the folder.

    If the log check finds errors, `accepted` logs are fitted all the same, and others are refused.
    """
    np.savez(folder / "log.npz", **log)
    options = Options(
        robot=folder / "arm.xml", data=folder / "log.npz", out=folder / "run", uncertainty=False, figures=False,
        accept_log=accepted,
    )  # fmt: skip
    return _verdict(folder / "run", lambda: run(options, "identify"))


def _verdict(folder: Path, fit: Callable[[], None]) -> dict[str, str]:
    """The verdict that a command stores in its run folder; "refused" if the command rejects the input."""
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(FitRefused):
            fit()
    except InputError as error:
        return {"level": "refused", "reason": str(error), "remedy": ""}
    return read_json(folder / "config.json", remedy="measure again")["chosen"]["verdict"]
