"""Work on one device and on several takes turns, and its report says how much several gain."""

from calls import assert_refused

from scripts.reports import scale
from scripts.reports.commands import scale_report


def test_works_take_turns():
    order = []
    works = {name: scale.Work(lambda name=name: name, order.append, 2) for name in ("one", "other")}
    assert list(scale.medians(works, 2)) == ["one", "other"] and order == ["one", "other"] * 3


def test_gains_are_ratios_of_seconds(monkeypatch):
    monkeypatch.setattr(scale, "batch_mesh", lambda devices: devices)
    monkeypatch.setattr(scale, "medians", lambda works, turns: {"1-devices": 6.0, "2-devices": 4.0})
    found = scale.compared("crawlers/8", lambda mesh: scale.Work(None, None, 2.0, {"share": mesh}), 2, 5)
    rows = {(row.case, row.quantity): row.value for row in found.rows}
    assert rows["crawlers/8/1-devices", "seconds_per_step"] == 3.0
    assert rows["crawlers/8/2-devices", "speed_up"] == 1.5 and rows["crawlers/8", "share"] == 1.0


def test_mistakes_are_one_line(capsys, tmp_path):
    rows = {
        "--lanes 8,x": "--lanes is '8,x'",
        "--lanes 0": "--lanes is '0'",
        "--sharing 0": "sharing is 0",
        "--only teapots": "teapots",
    }
    assert_refused(capsys, scale_report, rows.items(), out=tmp_path / "run")
