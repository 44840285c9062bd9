"""A quick run of both detectors' error rates meets the bounds of the report."""

import pytest

from scripts.reports.robots.arrival_and_repeats import arrival, repeated_motions


@pytest.mark.parametrize("measure", [arrival, repeated_motions])
def test_a_quick_run_meets_its_bounds(measure):
    rows = measure(True).rows
    assert rows and all(row.passed for row in rows)
