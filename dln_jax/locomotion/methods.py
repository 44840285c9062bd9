"""Learning methods by name, and training of several seeds."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from dln_jax.locomotion.evolution import EvolutionSettings, make_evolution_learner
from dln_jax.locomotion.gradient import GradientSettings, make_gradient_learner
from dln_jax.locomotion.learning import Compiled, Goal, Learned, Record, compile_learner, learn
from dln_jax.locomotion.policy import WIDTH, Parameters, Policy, make_policy
from dln_jax.locomotion.task import Task, Walk, beginning, walk
from dln_jax.types import InputError

Method = Literal["gradient", "evolution"]
METHODS: tuple[Method, ...] = get_args(Method)
SETTINGS: dict[str, Any] = {"gradient": GradientSettings(), "evolution": EvolutionSettings()}
WINDOWS = {"crawler": 40, "biped": 80, "quadruped": 40}
"""Steps that gradients go back, by creature: balance on two legs needs the whole episode."""
STEPS = {"gradient": 40_000, "evolution": 500_000}
"""Default numbers of environment steps."""

Report = Callable[[int, Record], None]


class Trained(NamedTuple):
    """Several seeds of one learning method."""

    policy: Policy
    learned: list[Learned]

    @property
    def best(self) -> Learned:
        """The seed with the longest distance."""
        return max(self.learned, key=lambda of: of.distance if np.isfinite(of.distance) else -np.inf)


def train(
    task: Task,
    method: Method,
    *,
    seeds: Sequence[int],
    goal: Goal,
    width: int = WIDTH,
    window: int | None = None,
    lanes: int | None = None,
    directory: Path | None = None,
    resume: bool = False,
    mesh: Mesh | None = None,
    report: Report = lambda seed, record: None,
) -> Trained:
    """Learns with several seeds; settings are the same for all seeds and, except the window, for all creatures.

    Args:
        task: to learn.
        method: "gradient" or "evolution".
        seeds: trained one after the other; programs are compiled once.
        goal: conditions that end the learning of a seed.
        width: of the hidden layer of the policy.
        window: steps that gradients go back (default: those of `WINDOWS`).
        lanes: creatures side by side, an even number (default: those of `SETTINGS`).
        directory: where states are stored.
        resume: continue the runs stored there.
        mesh: devices that share the creatures simulated side by side.
        report: called with seed and record after every evaluation.

    Raises:
        InputError: an unknown method, a stored run with other settings, or a mesh that does not divide the creatures.
    """
    if method not in METHODS:
        raise InputError(f"method '{method}' is unknown; choose from {', '.join(METHODS)}")
    chosen = settings_of(method, task.creature.name, window, lanes)
    make_learner = make_gradient_learner if method == "gradient" else make_evolution_learner
    compiled = compile_learner(task, make_learner(task, make_policy(task, width=width), chosen, mesh=mesh), mesh)
    settings: dict[str, Any] = {"creature": task.creature.name, "method": method, "width": width}
    settings |= {"episode": task.episode, "clock_period": task.clock_period, "upright": task.upright}
    settings |= chosen._asdict()
    stored = {"directory": directory, "settings": settings, "resume": resume}
    return learn_seeds(compiled, seeds, goal, report, **stored)


def learn_seeds(compiled: Compiled, seeds: Sequence[int], goal: Goal, report: Report, **stored: Any) -> Trained:
    """Learns with several seeds by one compiled method; `stored` are arguments of `learn` on checkpoints."""
    one = partial(learn, compiled, goal=goal, **stored)
    return Trained(compiled.learner.policy, [one(seed=seed, report=partial(report, seed)) for seed in seeds])


def settings_of(method: Method, creature: str, window: int | None = None, lanes: int | None = None) -> Any:
    """Returns the settings of a method for a creature; only the window of gradients depends on the creature.

    Raises:
        InputError: an odd number of lanes, which the methods take in pairs.
    """
    settings = SETTINGS[method]
    if lanes is not None and lanes % 2:
        raise InputError(f"{lanes} creatures are no pairs, in which {method} takes them; give an even number")
    if lanes is not None:
        settings = settings._replace(pairs=lanes // 2)
    if method != "gradient":
        return settings
    return settings._replace(window=window or WINDOWS.get(creature, GradientSettings().window))


def shown_walk(task: Task, policy: Policy, parameters: Parameters, steps: int) -> Walk:
    """Runs a policy from rest and returns its steps as NumPy arrays."""
    program = jax.jit(lambda p: walk(task, lambda seen: policy.apply(p, seen), beginning(task), steps)[1])
    return jax.tree.map(np.asarray, program(jax.tree.map(jnp.asarray, parameters)))
