"""Bands of a simulated arm cover its motions, and its far motions are flagged."""

import pytest

from scripts.reports.cases.uncertainty import simulated_arm


@pytest.mark.slow
def test_a_simulated_arm_is_covered_and_its_far_motions_are_flagged():
    numbers = simulated_arm(d=2, unmodelled=False, splits=2)["rigid-tree-2/friction-modelled"]
    assert numbers["coverage_95_lowest_joint"] >= 0.9 and numbers["coverage_95_highest_joint"] <= 0.98
    assert numbers["far_out_of_distribution_share"] > 0.9 > 0.5 > numbers["out_of_distribution_share"]
    assert numbers["far_coverage_95"] > 0.9
