"""Train one soft creature by gradients and by PPO, and print what each needs for five body lengths.

Several seeds each, until 6 body lengths or --steps. Writes report.json, and the model and gait of each method's best
seed. PPO needs the extra [rl].
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, ClassVar

from dln_jax.cli.arguments import Unstated, choice, names_in
from dln_jax.cli.options import Drawn, Folder, Scaled
from dln_jax.cli.scaled import mesh_of
from dln_jax.cli.stored_arguments import command_folder
from dln_jax.files import write_json
from dln_jax.locomotion.gradient import settings_of
from dln_jax.locomotion.task import FALLEN
from dln_jax.training.locomotion import (
    GOAL,
    LocomotionOptions,
    announce,
    median_to_reach,
    prepare,
    reported,
    trained,
    write_run,
)
from scripts.reports.locomotion import ppo
from scripts.reports.locomotion.comparison import comparison_rows
from scripts.reports.rows import conditions, print_report, write_report

RIVALS = {"ppo": (ppo, ppo.train_by_ppo)}


@dataclass(frozen=True)
class Arguments(LocomotionOptions, Folder, Drawn, Scaled):
    """What to compare, and where the results go."""

    MEASURES_COMPILATION: ClassVar = True

    rivals: Annotated[str, choice(RIVALS, several=True)] = ",".join(RIVALS)
    """Methods to compare with gradients, separated by commas."""
    seeds: int = 3
    """Seeds of each method, one after the other."""
    steps: Unstated[int] = None
    """Environment steps of each seed (default: 400000 by gradients, 300000 by ppo)."""
    until: Unstated[float] = 6.0
    """A seed ends at this distance, in body lengths (default: 6)."""
    start: float = 0.0
    """Standard deviation of the vertices' initial positions, m; rivals start at rest."""
    lanes: Unstated[int] = None
    """Creatures side by side, which devices share (default: 4 by gradients, 16 by ppo)."""


def main(options: Arguments) -> None:
    """Trains by all methods, prints the comparison and writes it."""
    mesh, lanes = mesh_of(options), options.lanes
    task = prepare(options, mesh)
    rivals = {name: RIVALS[name] for name in names_in("--rivals", options.rivals, RIVALS)}
    for rival, _ in rivals.values():
        rival.check(lanes, mesh)
    settings: dict[str, Any] = {"gradient": settings_of(options.window, lanes)}
    settings |= {method: rival.settings_of(lanes) for method, (rival, _) in rivals.items()}
    ways = {"gradient": partial(trained, task, options, mesh)}
    for method, (rival, run) in rivals.items():
        by_rival = partial(run, task, lanes=lanes, mesh=mesh)
        ways[method] = partial(reported, options, method, options.steps or rival.STEPS, by_rival)
    with command_folder(options, "compare_locomotion") as folder:
        announce(task)
        curves, numbers = {}, {}
        for method, train in ways.items():
            policies = train()
            (folder / method).mkdir()
            stated = settings[method]._asdict()
            metrics = write_run(folder / method, task, policies, stated, method=method, figures=options.figures)
            numbers |= {f"{method}_{name}": value for name, value in metrics.items()}
            curves[method] = [seed.records for seed in policies.learned]
        rows = comparison_rows(options.creature, curves, goal=GOAL, seed=options.seed)
        facts = conditions(
            dtype="float64; networks of ppo float32",
            seeds=list(range(options.seed, options.seed + options.seeds)),
            settings={method: values._asdict() for method, values in settings.items()},
            goal=f"{GOAL} body lengths in one episode of {task.episode} steps from rest, before a tilt of {FALLEN} rad",
            counted="environment steps of learning; one episode after each evaluation is apart",
            seconds="wall time with compilation and evaluation, which the first seed pays and every seed is charged",
        )
        write_report(folder / "report.json", rows, facts)
        write_json(folder / "metrics.json", numbers)
        print_report(rows, facts)
        if any(math.isinf(median_to_reach(seeds, GOAL, "steps")) for seeds in curves.values()):
            print("where a median was not reached, ratios take the steps that were allowed: they are lower bounds")
        print(f"run folder: {folder}")
