"""Expected gain of several hosts, teams of processes that take turns, and the report of both."""

import contextlib
import json

import pytest
from calls import command, refused

from dln_jax.types import InputError
from scripts.reports.case import Case, Findings
from scripts.reports.commands import scale_report
from scripts.reports.scale import cases, hosts
from scripts.reports.scale.turns import Layout, Measured, taken_in_turns, team, teams_of

SLOW = hosts.Network(rate=8e6, latency=1e-2)
"""A byte takes a microsecond."""


def ring(blocks, nodes):
    """Messages one after the other, and bytes of each link, by moving the blocks of a ring as they are moved."""
    held = [{node} for node in range(nodes)]
    messages = sent = 0
    while any(len(each) < nodes for each in held):
        moving = [(node + 1, (node - messages) % nodes) for node in range(nodes)]
        assert all(block in held[node - 1] for node, block in moving)
        for node, block in moving:
            held[node % nodes].add(block)
        messages, sent = messages + 1, sent + blocks / nodes
    return messages, sent


@pytest.mark.parametrize("nodes", [1, 2, 5])
def test_a_ring_is_what_the_formula_says(nodes):
    messages, sent = ring(1e6, nodes)
    gathering, summing = hosts.Exchange(gathered=1e6), hosts.Exchange(summed=1e6, sums=1)
    alone = messages * SLOW.latency + sent * 1e-6
    assert hosts.exchange_seconds(gathering, nodes, SLOW) == pytest.approx(alone)
    # A sum is scattered first, in as many messages, and then gathered.
    assert hosts.exchange_seconds(summing, nodes, SLOW) == pytest.approx(2 * alone)
    assert hosts.speed_up(3.0, gathering, nodes, SLOW) == pytest.approx(3.0 / (3.0 / nodes + alone))


def test_what_is_sent():
    assert hosts.of_results(64).gathered == 512 and hosts.of_results(64, 10).gathered == 5120
    assert hosts.of_gradient(260) == hosts.Exchange(summed=2080, sums=1)
    assert hosts.of_normal_equations(100).summed == 8 * (5000 + 300)


@pytest.mark.slow
def test_teams_answer_in_turn_and_say_why_they_cannot():
    layouts = {"one": Layout(), "devices": Layout(devices=2), "processes": Layout(processes=2)}
    work = {"work": "inverse-dynamics", "batch": 3, "dtype": "float32"}
    with contextlib.ExitStack() as stack:
        found = taken_in_turns(teams_of(stack, layouts), work, repetitions=1)
        assert list(found) == list(layouts)
        assert all(each.seconds > 0 and each.processors > 0 for each in found.values())
        ask, seen = stack.enter_context(team(Layout()))
        assert seen["platform"] == "cpu" and seen["devices"] == 1
        with pytest.raises(InputError, match="ended: KeyError: 'teapots'"):
            ask({"work": "teapots"})


def test_gains_are_ratios_of_seconds():
    found = {cases.BASE: Measured(6.0, 1.0, {}), "2-devices": Measured(4.0, 1.9, {})}
    assert cases.gains(found) == {"2-devices": 1.5}
    rows = {
        (row.case, row.quantity): row.value for row in cases.compared("crawlers/8", found, "seconds_per_lane_step", 2.0)
    }
    assert rows["crawlers/8/one-device", "seconds_per_lane_step"] == 3.0
    assert rows["crawlers/8/2-devices", "speed_up"] == 1.5 and rows["crawlers/8/2-devices", "busy_cores"] == 1.9


def test_the_report_tells_what_was_measured_from_what_is_modelled(monkeypatch, capsys, tmp_path):
    found = {cases.BASE: Measured(6.0, 1.0, {}), "2-devices": Measured(4.0, 1.9, {})}
    measured = cases.compared("crawlers/8", found, "seconds_per_lane_step", 2.0)
    modelled = hosts.rows("evolution", 5.0, hosts.of_results(64))
    curves = {"measured": {"8": cases.gains(found)}, "modelled": {"evolution": hosts.curves(modelled)}}
    crawlers = Findings(measured + modelled, curves)
    given = []

    def few(**arguments):
        given.append(arguments)
        return [
            Case("crawlers", lambda: crawlers, draw=lambda curves: cases.draw("crawlers", curves)),
            Case("accelerator", lambda: Findings([])),
        ]

    monkeypatch.setattr(scale_report, "cases", few)
    command(
        scale_report, "--only", "crawlers,accelerator", "--lanes", "8,4", "--sharing", "3", "--out", tmp_path / "out"
    )
    said = capsys.readouterr().out
    assert given == [{"quick": False, "lanes": (8, 4), "count": 3}]
    assert "accelerator: not measured, JAX sees none" in said and "| hosts/evolution/1_gbit |" in said
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert len(report["rows"]) == len(crawlers.rows) and report["conditions"]["networks"]["1_gbit"]["rate"] == 1e9
    assert json.loads((tmp_path / "out/metrics.json").read_text())["crawlers/8/2-devices/speed_up"] == 1.5
    assert (tmp_path / "out/crawlers.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--lanes", "8,x"), "--lanes is '8,x'"),
        (("--lanes", "0"), "--lanes is '0'"),
        (("--sharing", "0"), "sharing is 0"),
        (("--only", "teapots"), "teapots"),
    ],
)
def test_mistakes_are_one_line(capsys, monkeypatch, tmp_path, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert message in refused(capsys, scale_report, *arguments)
    assert not (tmp_path / "runs").exists()
