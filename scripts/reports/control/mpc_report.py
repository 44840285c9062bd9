"""The rows of model predictive control of a cart-pole: success from many starts, and the time of a call."""

import numpy as np

from scripts.reports.case import Findings
from scripts.reports.control.mpc import HORIZONS, RATE, swing_ups
from scripts.reports.control.mpc_calls import calls_in_a_process
from scripts.reports.rows import Row, expect

STARTS, LOOPS = 30, 10
"""Number of swing-ups, and number of loops with timed calls."""
WITHIN = 1e3 / RATE
"""Time limit of a call, ms."""


def mpc(quick: bool) -> Findings:
    """Success and time to swing up by horizon, and single-threaded times of a call in JAX and in C, ms."""
    rows: list[Row] = []
    for seconds in HORIZONS[:1] if quick else HORIZONS:
        steps = round(seconds * RATE)
        case, times = f"mpc/{seconds:g}-s", swing_ups(steps, 2 if quick else STARTS)
        words, reached = f"of {len(times)} starts", times[np.isfinite(times)]
        rows.append(Row(case, "success_share", float(np.isfinite(times).mean()), expected=words))
        for quantity, of in (("median", np.median), ("worst", np.max)):
            rows.append(Row(case, f"seconds_{quantity}", float(of(reached)) if len(reached) else np.inf, "s"))
        # Only the longest horizon is timed: its calls take the most time.
        timed = calls_in_a_process(steps, 1 if quick else LOOPS) if seconds == HORIZONS[0] else {}
        for way, found in timed.items():
            rows.append(Row(f"{case}/{way}", "compile_seconds", found.compile_seconds, "s"))
            rows.append(Row(f"{case}/{way}", "p50_ms", found.p50_ms, "ms"))
            rows.append(expect(f"{case}/{way}", "p99_ms", f"of {found.calls} calls", found.p99_ms, WITHIN, "ms"))
            rows.append(Row(f"{case}/{way}", "worst_ms", found.worst_ms, "ms"))
    return Findings(rows)
