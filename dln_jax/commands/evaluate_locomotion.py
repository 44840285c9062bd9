"""Evaluate a stored policy of a soft creature.

Runs episodes from perturbed starts on the steepest slopes, up and down, that --slope allows. The ground is that of the
training unless options state it. Prints the number of episodes without a fall, the distances before a fall, and a
verdict: good if at least 95 % have no fall and none goes backwards, refused below 50 % (exit status 1). Writes
metrics.json.
"""

from dataclasses import dataclass
from pathlib import Path

from dln_jax.options import Folder, Unstated


@dataclass(frozen=True, kw_only=True)
class Arguments(Folder):
    """The policy, its ground, and where the results go."""

    run: Path
    """Folder of a run of train_locomotion."""
    start: Unstated[float] = None
    """Standard deviation of the vertices' initial positions, m; of their velocities, 10 times as much in m/s (default:
    the training's)."""
    slope: Unstated[float] = None
    """Slope of the ground, degrees (default: the training's largest)."""
    rough: Unstated[float] = None
    """Largest height of bumps, m (default: the training's)."""
    push: Unstated[float] = None
    """Change of velocity by the pushes, m/s (default: the training's)."""
    starts: int = 100
    """Number of episodes."""
    steps: int = 2000
    """Steps of an episode, 0.033 s each."""
    seed: int = 1_000_000
    """Seed of the starts, 0 to 4294967295; the default is one that no training draws."""


def main(options: Arguments) -> None:
    """Evaluates the policy, prints and writes the numbers."""
    from dln_jax.commands.locomotion import LABELS, UNITS, judge, load_policy
    from dln_jax.locomotion.learning import numbers_of, perturbed_trials
    from dln_jax.runs.folder import command_folder
    from dln_jax.runs.report import Report, finish, rows_of
    from dln_jax.types import require_positive

    sizes = {"starts": options.starts, "steps": options.steps}
    require_positive(**sizes)
    ground = {name: getattr(options, name) for name in ("start", "slope", "rough", "push")}
    task, policy, parameters, _ = load_policy(options.run, **ground)
    with command_folder(options, "evaluate_locomotion") as folder:
        trials = perturbed_trials(task, policy, parameters, **sizes, seed=options.seed)
        verdict, numbers = judge(trials, options.steps), numbers_of(trials, options.steps)
        title = ", ".join(f"{name} {value:g}" for name, value in task.variation._asdict().items())
        title = f"{task.creature.name}: {title}"
        metrics = {**numbers, "verdict": verdict.number}
        finish(folder, options, Report(metrics, rows_of(numbers, LABELS, UNITS), title, verdict=verdict))
