"""Measure what several devices of one process gain over one device.

Crawlers are soft bodies stepped side by side; training is that of a small network. One device and several take turns;
compilation is apart, results are waited for, medians count.
"""

from functools import partial

from scripts.reports.run import Case
from scripts.reports.scale import TRAININGS, measure_crawlers, measure_training

CASES = (
    *(
        Case(f"crawlers/{lanes}", measure_crawlers, {"lanes": lanes}, quick={"steps": 2, "turns": 2})
        for lanes in (64, 512, 4096)
    ),
    *(
        Case(f"training/{name}", partial(measure_training, name), quick={"samples": 1024, "turns": 2})
        for name in TRAININGS
    ),
)
