"""Measure whether models know what they do not know: coverage of 95 % bands on held-out motions, and flags.

Rigid trees of simulated arms, with the friction that they have and with friction that they lack; structured networks of
the embedded letters, exact and noisy; and recordings of a real arm and a real double pendulum where they are given.
"""

from scripts.reports.run import AtLeast, Case
from scripts.reports.uncertainty import double_pendulum, letters, simulated_arm, ur10

BOUND = {"coverage_95_lowest_joint": AtLeast(0.90), "coverage_95_highest_joint": 0.98}
FEW = {"splits": 1}

CASES = (
    *(
        Case(
            f"rigid-tree-{d}/friction-{'unmodelled' if unmodelled else 'modelled'}",
            simulated_arm,
            {"d": d, "unmodelled": unmodelled},
            FEW,
            bound=BOUND,
        )
        for d in (3, 7)
        for unmodelled in (False, True)
    ),
    *(
        Case(f"structured-delan/letters-{name}", letters, {"noise": noise}, {**FEW, "steps": 20}, bound=BOUND)
        for name, noise in (("exact", 0.0), ("noisy", 0.01))
    ),
    Case("rigid-tree/ur10", ur10, quick=FEW, bound=BOUND),
    Case("rigid-tree/double-pendulum", double_pendulum, quick=FEW, bound=BOUND),
)
