"""Measure creatures that learn to move by gradients and by PPO (extra [rl]), and the published biped's own policy.

`comparison` trains several seeds of each method until 6 body lengths and states what five body lengths take.
`published` takes --data FILE with the published biped: how far it walks in 2,000 steps, and how often it falls.
"""

from scripts.reports.locomotion import BIPED, measure_biped, measure_comparison
from scripts.reports.run import AtLeast, Case

CASES = (
    Case(
        "comparison/crawler",
        measure_comparison,
        quick={"seeds": 1, "steps": 1_280, "rivals": ()},
        bound={
            "crawler/gradient seconds_to_five_body_lengths": 60.0,
            "crawler/ppo environment_steps_ratio_to_gradient": AtLeast(3.0),
        },
    ),
    Case(
        "published/biped",
        measure_biped,
        published={"distance_body_lengths": BIPED},
        bound={"relative_difference": 0.02},
        by_name_only=True,
    ),
)
