"""The cases of `scale_report`: one device against several and against several processes."""

import contextlib
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from matplotlib.figure import Figure

from scripts.reports.case import Case, Findings
from scripts.reports.figures.scale import speed_ups
from scripts.reports.rows import Row
from scripts.reports.scale import hosts
from scripts.reports.scale.turns import Layout, Measured, taken_in_turns, team, teams_of

LANES = (64, 512, 4096)
STEPS = 10
"""Steps of a crawler per turn."""
EPISODE = 80
"""Steps of an episode in evolution."""
TURNS = 5
BATCH = 65_536
"""Number of states in the batch of inverse dynamics."""
SAMPLES = 4096
TRAININGS = {"adam": {"optimiser": "adam", "steps": 200}, "gauss-newton": {"optimiser": "gauss-newton", "steps": 5}}
BASE = "one-device"


def layouts(count: int) -> dict[str, Layout]:
    """One device, `count` devices of one process, and `count` processes."""
    return {BASE: Layout(), f"{count}-devices": Layout(devices=count), f"{count}-processes": Layout(processes=count)}


def cases(*, quick: bool, lanes: Sequence[int] | None = None, count: int = 2) -> list[Case]:
    """All cases; `lanes` are the numbers of crawlers, and `count` devices or processes share the work."""
    lanes = lanes or ((16,) if quick else LANES)
    turns, samples = (2, 1024) if quick else (TURNS, SAMPLES)
    of_crawlers = partial(measure_crawlers, lanes, 2 if quick else STEPS, turns, count)
    return [
        Case("crawlers", of_crawlers, draw=partial(draw, "crawlers side by side")),
        Case("training", partial(measure_training, samples, turns, count), draw=partial(draw, "optimiser")),
        Case("accelerator", partial(measure_accelerator, quick, lanes[-1], turns)),
    ]


def measure_crawlers(lanes: Sequence[int], steps: int, turns: int, count: int) -> Findings:
    """Time per step of a crawler in batches of many, and the modelled speed-up of evolution by hosts."""
    rows, curves, alone = [], {}, 0.0
    with contextlib.ExitStack() as stack:
        teams = teams_of(stack, layouts(count))
        for number in lanes:
            times = taken_in_turns(teams, {"work": "crawlers", "lanes": number, "steps": steps}, turns)
            alone = times[BASE].seconds / (number * steps)
            case = f"crawlers/{number}"
            rows += compared(case, times, "seconds_per_lane_step", number * steps)
            facts = times[BASE].facts
            rows += [Row(case, name, facts[name]) for name in ("useful_iterations_share", "converged_share")]
            curves[str(number)] = gains(times)
    generation = max(lanes)
    modelled = hosts.rows("evolution", generation * EPISODE * alone, hosts.of_results(generation))
    return Findings(rows + modelled, {"measured": curves, "modelled": {"evolution": hosts.curves(modelled)}})


def measure_training(samples: int, turns: int, count: int) -> Findings:
    """Time per training step of a small network, and its modelled speed-up by hosts."""
    rows, curves, lines = [], {}, {}
    with contextlib.ExitStack() as stack:
        teams = teams_of(stack, layouts(count))
        for name, work in TRAININGS.items():
            times = taken_in_turns(teams, {"work": "training", "samples": samples, **work}, turns)
            facts = times[BASE].facts
            parameters = int(facts["parameters"])
            rows += compared(f"training/{name}", times, "seconds_per_step", facts["steps"])
            rows.append(Row(f"training/{name}", "parameters", parameters))
            exchange = hosts.of_gradient(parameters) if name == "adam" else hosts.of_normal_equations(parameters)
            modelled = hosts.rows(name, times[BASE].seconds / facts["steps"], exchange)
            rows += modelled
            curves[name], lines[name] = gains(times), hosts.curves(modelled)
    return Findings(rows, {"measured": curves, "modelled": lines})


def measure_accelerator(quick: bool, lanes: int, turns: int) -> Findings:
    """Compares an accelerator with the processor; no rows if JAX sees no accelerator."""
    with team(Layout(platform="")) as (_, seen):
        platform, kind = str(seen["platform"]), str(seen["kind"])
    if platform == "cpu":
        return Findings([])
    rows, batch = [], 1024 if quick else BATCH
    asked: dict[str, tuple[dict[str, Any], str, float]] = {
        f"inverse-dynamics/{dtype}": (
            {"work": "inverse-dynamics", "batch": batch, "dtype": dtype},
            "seconds_per_state",
            batch,
        )
        for dtype in ("float32", "float64")
    }
    for name, training in TRAININGS.items():
        work = {"work": "training", "samples": SAMPLES, **training}
        asked[f"training/{name}"] = (work, "seconds_per_step", float(training["steps"]))
    asked["crawlers"] = ({"work": "crawlers", "lanes": lanes, "steps": STEPS}, "seconds_per_lane_step", lanes * STEPS)
    with contextlib.ExitStack() as stack:
        teams = teams_of(stack, {BASE: Layout(), "-".join(kind.lower().split()): Layout(platform=platform)})
        for name, (work, quantity, count) in asked.items():
            rows += compared(f"accelerator/{name}", taken_in_turns(teams, work, turns), quantity, count)
    return Findings(rows)


def compared(case: str, times: Mapping[str, Measured], quantity: str, count: float) -> list[Row]:
    """Time of one in `count` work items by layout, number of busy cores, and speed-up over one device."""
    rows = []
    for name, measured in times.items():
        at = f"{case}/{name}"
        rows += [Row(at, quantity, measured.seconds / count, "s"), Row(at, "busy_cores", measured.processors)]
    return rows + [Row(f"{case}/{name}", "speed_up", gain) for name, gain in gains(times).items()]


def gains(times: Mapping[str, Measured]) -> dict[str, float]:
    """Speed-ups of the other layouts over one device."""
    return {name: times[BASE].seconds / measured.seconds for name, measured in times.items() if name != BASE}


def draw(x: str, curves: dict[str, Any]) -> Figure:
    """Draws measured and modelled speed-ups."""
    return speed_ups(curves["measured"], curves["modelled"], hosts=hosts.HOSTS, x=x)
