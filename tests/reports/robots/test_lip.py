"""On the LIP protocol a small arm is learned to the floor of known kinematics, and nearly so by a kernel."""

import pytest

from scripts.reports.robots import lip


@pytest.mark.slow
def test_three_joints_are_at_the_floor():
    rows = {(row.case, row.quantity): row for row in lip.rows("panda-3", friction=False, every=100, tests=(101,))}
    case = "lip/panda-3/frictionless/50"
    assert rows[f"{case}/learned-tree", "share_of_seeds_at_floor"].value == 1
    learned, known = (rows[f"{case}/{name}", "nmse_mean_median"].value for name in ("learned-tree", "known-kinematics"))
    assert learned < 1e-5 and known < 1e-5
    assert rows[f"{case}/learned-tree", "nmse_mean_median"].reference == pytest.approx(known)
