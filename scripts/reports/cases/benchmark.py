"""Measure speed against error: single calls, batches, growth with the number of joints, and exported C.

Compilation is timed apart, results are waited for, inputs vary, programs that are compared take turns, and medians
count.
"""

from scripts.reports.arm.models import TRIGONOMETRIC
from scripts.reports.run import AtLeast, Case
from scripts.reports.speed import exported_c, networks

AGREES = 1e-11
"""Largest relative difference of results of two programs of one model."""
CASES = (
    Case(
        "one-step/two-link-arm",
        networks.single_calls,
        quick={
            "models": (networks.WIDE, TRIGONOMETRIC),
            "calls": 1_000,
            "processes": 1,
            "adam_steps": 200,
        },
        bound={
            f"one-step/{networks.WIDE}/low-latency-jit inverse_p50_us": 13.0,
            f"one-step/{networks.WIDE}/low-latency-jit inverse_p99_over_p50": 3.0,
            f"one-step/{networks.WIDE}/c-from-python inverse_p50_us": 6.0,
            f"one-step/{networks.WIDE}/c-loop inverse_calls_per_second": AtLeast(200_000.0),
            "one-step/structured-delan/c-loop inverse_calls_per_second": AtLeast(1_500_000.0),
        },
    ),
    Case(
        "throughput/structured-delan",
        networks.throughput,
        quick={"batches": (1, 1_000), "joints": (2,), "repetitions": 10},
        bound={"throughput/full-hessian/d-2 speedup": AtLeast(4.0)},
    ),
    Case(
        "scaling/structured-delan",
        networks.scaling,
        quick={"joints": (2, 4), "calls": 500, "repetitions": 50},
        bound={"inverse_p50_us_exponent": 2.0},
    ),
    Case(
        "c/structured-delan",
        exported_c.exported,
        quick={
            "arms": ("structured-delan-8x8-f64-d-2", "structured-delan-8x8-f64-d-7"),
            "largest": 0,
            "turns": 2,
            "repeats": 3,
            "calls": 200,
            "cold": 50,
            "repetitions": 20,
        },
        bound={
            **{f"c/{arm}/{exported_c.JACOBIAN} over_inverse": d + 3.0 for arm, (*_, d) in exported_c.ARMS.items()},
            f"c/{exported_c.LARGEST} making_seconds": 20.0,
            "over_rnea": 1.0,
            "over_aba": 1.0,
        },
    ),
    Case(
        "casadi/two-link-arm",
        exported_c.beside_casadi,
        quick={"turns": 2, "repeats": 3, "calls": 500, "cold": 50},
        bound={"over_casadi": 1.0, "relative_difference": AGREES},
    ),
)
