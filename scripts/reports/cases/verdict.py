"""Measure the verdict on fitted robots and motions: sound logs must be good, spoiled ones refused."""

from scripts.reports import verdicts
from scripts.reports.run import AtLeast, Case

CASES = (
    Case(
        "identify/logs",
        verdicts.identified,
        quick={"logs": 1},
        bound={
            "identify/sound good_share": AtLeast(1.0),
            **{f"identify/{fault} refused_share": AtLeast(1.0) for fault in verdicts.REFUSED},
            **{f"identify/{fault} good_share": 0.0 for fault in verdicts.DOUBTFUL},
        },
    ),
    Case(
        "learned-tree/logs",
        verdicts.learned,
        quick={"learned": 1},
        bound={
            # The arms' friction has offsets, which such a tree does not model.
            "learned-tree/sound refused_share": 0.0,
            **{f"learned-tree/{fault} good_share": 0.0 for fault in verdicts.OF_TREES},
        },
    ),
    Case("motions/plants", verdicts.motions, quick={"motions": 1}, bound={"wrong_share": 0.0}),
)
