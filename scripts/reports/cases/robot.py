"""Measure robots: identification, tracking, learned kinematics, real logs and speed, beside rivals in the same run.

Rivals are measured where they are installed: pip install 'dln-jax[reference]'. Recordings are measured where they are
given. Only `speed` depends on the machine.
"""

from scripts.reports.robots import known_kinematics, learned, log_checks, recordings
from scripts.reports.robots.arm import speed
from scripts.reports.run import AtLeast, Case

FEW = {"seeds": 1, "motions": 4, "unseen": 2}
FLOOR = {"training_error_over_floor": 1.1, "share_of_seeds_at_floor": AtLeast(0.9), "fit_seconds": 180.0}
TARGETS = {**FLOOR, "nmse_mean_median": 1e-3}
SMALLER = ("panda-3", "panda-4", "panda-5", "panda-6", "skew-arm", "sliding-arm")
TINY = {"arms": ("panda-3",), "frictions": (False,), "seeds": 1, "tests": 2}
# The LIP paper's kernel from 500 samples without friction: about 3 %, and below 10 %.
KERNEL = {f"lip/panda-{d}/frictionless/500/kernel nmse_mean_median": error for d, error in ((6, 0.03), (7, 0.1))}
ERRORS = {"found": AtLeast(0.9), "false_alarms": 0.02, "wrongly_joined": 0.02}
ONE_SPLIT = {"splits": 1}

CASES = (
    Case(
        "arm/noisy",
        known_kinematics.noisy,
        quick=FEW,
        bound={
            "arm/noisy-coulomb/ours nmse": 1.65e-3,
            "over_pinocchio": 1.0,
            "over_pinocchio-with-our-scales": 1.0,
            "over_true_parameters": 1.1,
        },
    ),
    Case("learned/seven-joints", learned.learned_trees, {"arms": ("panda-7",), "seeds": 10}, TINY, {}, TARGETS),
    Case("learned/fewer-joints", learned.learned_trees, {"arms": SMALLER}, TINY, {}, TARGETS),
    Case(
        "learned/fewer-samples",
        learned.learned_trees,
        {"arms": ("panda-7",), "samples": (150, 50)},
        {**TINY, "samples": (50,)},
        {},
        FLOOR,
    ),
    Case(
        "learned/kernels",
        learned.kernels,
        quick={"fits": (("panda-3", 50, False, True),), "tests": 1},
        published=KERNEL,
        bound=KERNEL,
    ),
    Case("learned/unknown-trees", learned.unknown_trees, quick={"plants": ("branched",), "fit_seconds": 5.0}),
    Case("preparation/encoders", known_kinematics.encoders, quick={"motions": 4, "unseen": 2, "parts": 1}),
    Case(
        "preparation/excitation",
        known_kinematics.excitation,
        quick={"joints": 3, "designs": 2},
        bound={"excitation/information error_median": 1.0},
    ),
    Case("logs/sound", log_checks.sound, quick={"logs": 6}, bound=ERRORS),
    Case("logs/faults", log_checks.faults, quick={"faulty_logs": 1}, bound=ERRORS),
    Case("logs/arrival", log_checks.arrival, quick={"stamped_logs": 3}, bound={**ERRORS, "error_left": 0.1}),
    Case("logs/repeated-motions", log_checks.repeated_motions, quick={"sets": 1}, bound=ERRORS),
    Case("terms/two-joints", known_kinematics.added_terms, quick={"logs_without": 2, "logs_with": 2}),
    Case("speed/seven-axis", speed, quick={"repetitions": 20}, bound={"over_rnea": 2.0, "over_aba": 2.0}),
    Case(
        "recordings/arm",
        recordings.recorded_arm,
        quick={"pairs": 1},
        bound={"over_without": 1.0, "over_pinocchio": 1.0},
    ),
    Case("recordings/double-pendulum", recordings.double_pendulum, quick=ONE_SPLIT),
    Case(
        "recordings/identify-by",
        recordings.identify_by,
        quick=ONE_SPLIT,
        bound={
            "identify-by/motions vpt_over_torques_worst": AtLeast(1.0),
            "identify-by/both vpt_over_torques_median": AtLeast(1.2),
        },
    ),
)
