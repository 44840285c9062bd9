"""The report of uncertainties draws and reads the data that it names, and its cases give their rows."""

import pytest

from scripts.reports.uncertainty import cases


@pytest.mark.slow
def test_a_simulated_arm_is_covered_and_its_far_motions_are_flagged():
    rows = {row.quantity: row for row in cases.simulated_arm("arm", 2, noise=0.3, unmodelled=False, splits=2).rows}
    assert rows["coverage_95_lowest_joint"].passed and rows["coverage_95_highest_joint"].passed
    assert rows["far_out_of_distribution_share"].value > 0.9 > 0.5 > rows["out_of_distribution_share"].value
    assert rows["far_coverage_95"].value > 0.9


def test_recordings_are_cases_where_their_files_are_given(tmp_path):
    names = [case.name for case in cases.cases(splits=1)]
    more = [case.name for case in cases.cases(splits=1, recorded_arm=tmp_path, recorded_pendulum=tmp_path)]
    assert set(more) - set(names) == {"rigid-tree/ur10", "rigid-tree/double-pendulum"}
