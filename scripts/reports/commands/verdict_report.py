"""Measure the verdict on identified robots: sound logs of random arms must be good, spoiled ones refused.

Each log is identified as the command identify does, from a robot's file with rough masses. Prints one table (case,
quantity, expected, value, unit, to reach, pass) and writes report.json.
"""

import contextlib
import io
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dln_jax.command_line.options import Folder
from dln_jax.command_line.running import command_folder
from dln_jax.data.mjcf import mjcf
from dln_jax.files import read_json
from dln_jax.metrics.report import Row, expect
from dln_jax.metrics.verdict import LEVELS, FitRefused
from dln_jax.runs.identification import run
from dln_jax.runs.identification_task import Options
from dln_jax.types import InputError, require_positive, require_seed
from scripts.reports.case import Case, Findings, measure_and_publish
from scripts.reports.robots.faulty_logs import FAULTS, Arrays, random_arm, rough_file, sound_log

JOINTS = (2, 3, 4, 6)
"""Of the arms, one after the other."""
NOISES = (0.0, 0.01, 0.05, 0.1)
"""Of the torques, in units of each one's deviation."""


@dataclass(frozen=True)
class Arguments(Folder):
    """How many logs."""

    logs: int = 6
    """Sound ones, each of an arm of its own; each is then spoiled in every way."""
    seed: int = 100
    """Of the first arm; thresholds were chosen by seeds below 100."""


def main(given: Arguments) -> None:
    """Measures, prints and writes."""
    require_positive(logs=given.logs)
    require_seed(given.seed)
    with command_folder(given, "verdicts") as folder:
        cases = [Case("sound", lambda: findings(given, "sound", None))]
        cases += [Case(name, lambda name=name: findings(given, name, name)) for name in FAULTS]
        measure_and_publish(folder, cases, dtype="float64", seeds=[given.seed, given.seed + given.logs - 1])


def findings(given: Arguments, name: str, fault: str | None) -> Findings:
    """How many logs got which verdict."""
    counts = Counter(verdict_of(seed, fault) for seed in range(given.seed, given.seed + given.logs))
    shares = {level: counts[level] / given.logs for level in LEVELS}
    rows = [Row(f"identify/{name}", f"{level}_share", shares[level]) for level in LEVELS]
    if fault is None:
        rows[0] = expect(f"identify/{name}", "good_share", "sound logs are good", shares["good"], 1.0, at_least=True)
    elif FAULTS[fault].level == "refused":
        rows[2] = expect(f"identify/{name}", "refused_share", "ruined", shares["refused"], 1.0, at_least=True)
    else:
        rows[0] = expect(f"identify/{name}", "good_share", "spoiled: at least doubtful", shares["good"], 0.0)
    return Findings(rows)


def verdict_of(seed: int, fault: str | None) -> str:
    """The verdict on one log."""
    arm = random_arm(seed, JOINTS[seed % len(JOINTS)])
    log = sound_log(arm, seed, NOISES[(3 * seed + seed // len(JOINTS)) % len(NOISES)])
    if fault is not None:
        log = FAULTS[fault].spoil(log, np.random.default_rng([seed, 3]))
    with tempfile.TemporaryDirectory(prefix="dln_jax-") as name:
        folder = Path(name)
        (folder / "arm.xml").write_text(mjcf(rough_file(arm, seed)))
        return identified(folder, log, accepted=fault is not None)["level"]


def identified(folder: Path, log: Arrays, *, accepted: bool) -> dict[str, str]:
    """The verdict on a log, with reason and remedy, by the robot's file arm.xml in the folder.

    Logs that are `accepted` are fitted although the check of the log finds errors; others are then refused.
    """
    np.savez(folder / "log.npz", **log)
    options = Options(
        robot=folder / "arm.xml", data=folder / "log.npz", out=folder / "run", uncertainty=False, figures=False,
        accept_log=accepted,
    )  # fmt: skip
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(FitRefused):
            run(options, "identify")
    except InputError as error:
        return {"level": "refused", "reason": str(error), "remedy": ""}
    return read_json(folder / "run" / "config.json", remedy="measure again")["chosen"]["verdict"]
