"""Measure creatures that learn to move by gradients and by PPO (extra [rl]), and the published biped's own policy.

`comparison` trains several seeds of each method until 6 body lengths and states what five body lengths take.
`published` takes --data FILE with the published biped: how far it walks in 2,000 steps, and how often it falls.
"""

import copy
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.wrappers import TransformReward
from jaxtyping import Float

from dln_jax.data.arrays import load_file
from dln_jax.locomotion.gradient import Parameters, Policy, shown_walk
from dln_jax.locomotion.learning import GOAL, STEPS, Record, median_to_reach, numbers_of, perturbed_trials, train
from dln_jax.locomotion.task import (
    FALLEN,
    POSITION_UNIT,
    Frame,
    LocomotionTask,
    advance,
    beginning,
    change_of,
    make_task,
    observe,
)
from dln_jax.locomotion.worlds import FLAT, Variation
from dln_jax.softbody.mesh.mesh import make_mesh
from dln_jax.softbody.mesh.shapes import Creature, crawler
from dln_jax.softbody.terms.creature import TIME_STEP
from dln_jax.types import InputError
from scripts.reports.run import AtLeast, Case, Numbers

UNTIL = 6.0
"""Distance at which a seed ends, body lengths."""
BIPED = 41.37
"""Body lengths of the published biped in 2,000 steps from rest in its author's program."""
LAYERS = (f"policy_fc{i}_{part}" for i in (1, 2) for part in ("weight", "bias"))
NAMES = ("vertices", "triangles", "muscles", *LAYERS, "policy_center_vertex_id", "policy_forward_vertex_id")
KEYS = tuple(f"biped_{name}" for name in NAMES)
"""Arrays of the published creature's file."""


class CreatureEnvironment(gymnasium.Env[np.ndarray, np.ndarray]):
    """Environment of one creature for learners of other libraries, in NumPy and float32, with the task's rewards.

    Actions in [-1, 1] are commands: the actuation approaches theirs by at most 0.3 per step. An episode is truncated
    after the task's number of steps. It is terminated by a fall, or by a step of the simulator that does not converge;
    `info["converged"]` distinguishes the two.
    """

    def __init__(self, task: LocomotionTask):
        self.task = task
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (task.observation_size,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (task.muscle_count,), np.float32)
        self._place = beginning(task)
        self._begin = jax.jit(lambda key: beginning(task, key))
        self._advance = jax.jit(lambda place, action: advance(task, place, change_of(place.actuation, action)))
        self._observe = jax.jit(lambda place: observe(task, place))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float[np.ndarray, " o"], dict[str, Any]]:
        """Returns the observation of a start perturbed by the task's variation; without one, at rest.

        Raises:
            InputError: there are options, of which this environment has none.
        """
        if options:
            raise InputError(f"reset got the options {', '.join(options)}; this environment has none")
        super().reset(seed=seed, options=options)
        self._place = self._begin(jax.random.key(int(self.np_random.integers(2**31))))
        return self._observation(), {}

    def step(
        self, action: Float[np.ndarray, " k"]
    ) -> tuple[Float[np.ndarray, " o"], float, bool, bool, dict[str, Any]]:
        """Returns observation, reward, terminated, truncated, and `info` with "x" [n, dim] in m and "converged"."""
        self._place, seen = self._advance(self._place, np.asarray(action, self._place.state.x.dtype))
        converged = bool(seen.converged)
        terminated = not converged or float(seen.tilt) > FALLEN
        truncated = int(self._place.steps) >= self.task.episode
        info = {"x": np.asarray(seen.x), "converged": converged}
        return self._observation(), float(seen.reward), terminated, truncated, info

    def _observation(self) -> Float[np.ndarray, " o"]:
        return np.asarray(self._observe(self._place), np.float32)


def measure_comparison(*, rivals: tuple[str, ...] = ("ppo",), seeds: int = 3, steps: int = 300_000) -> Numbers:
    """Environment steps and seconds of each method until five body lengths, and their ratio to gradients.

    Args:
        rivals: methods beside gradients; ppo takes the extra [rl].
        steps: environment steps that a seed may take; a ratio to a method that needs more is a lower bound.
    """
    if unknown := set(rivals) - {"ppo"}:
        raise InputError(f"--rivals names {unknown.pop()!r:.40}; choose from ppo")
    task = make_task(crawler())
    curves = {"gradient": [one.records for one in train(task, seeds=range(seeds), steps=steps, until=UNTIL)]}
    if rivals:
        curves["ppo"] = [learn_by_ppo(task, seed, steps) for seed in range(seeds)]
    numbers: dict[str, dict[str, float]] = {}
    needed = {}
    for method, records in curves.items():
        rows = {}
        for seed, of_seed in enumerate(records):
            rows[f"environment_steps_to_five_body_lengths_seed_{seed}"] = median_to_reach([of_seed], GOAL, "steps")
        median = median_to_reach(records, GOAL, "steps")
        needed[method] = min(median, max(of_seed[-1].steps for of_seed in records))
        rows["environment_steps_to_five_body_lengths"] = median
        rows["seconds_to_five_body_lengths"] = median_to_reach(records, GOAL, "seconds")
        if method != "gradient":
            rows["environment_steps_ratio_to_gradient"] = needed[method] / needed["gradient"]
        numbers[f"crawler/{method}"] = rows
    return numbers


def learn_by_ppo(task: LocomotionTask, seed: int, steps: int, *, lanes: int = 16, rollout: int = 80) -> list[Record]:
    """Proximal policy optimisation (Schulman et al. 2017) by stable-baselines3; evaluates after every update."""
    try:
        import torch  # pyright: ignore[reportMissingImports]
        from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]
        from stable_baselines3.common.env_util import make_vec_env  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError("ppo needs stable-baselines3; install it by: pip install 'dln-jax[rl]'") from None
    torch.set_num_threads(1)  # networks of this size are slower on several threads
    began = time.perf_counter()
    one = CreatureEnvironment(task)

    def lane():
        # Copies share the compiled programs. Rewards in body lengths per second suit the critic.
        return TransformReward(copy.copy(one), lambda reward: float(reward) / TIME_STEP)

    model = PPO(
        "MlpPolicy", make_vec_env(lane, n_envs=lanes, seed=seed), n_steps=rollout, batch_size=256, n_epochs=10,
        learning_rate=1e-3, gamma=0.98, gae_lambda=0.95, seed=seed, device="cpu",
        policy_kwargs={"net_arch": [64, 64], "log_std_init": math.log(0.6)},
    )  # fmt: skip
    records: list[Record] = []
    while model.num_timesteps < steps and not (records and records[-1].distance >= UNTIL):
        model.learn(lanes * rollout, reset_num_timesteps=not records)
        seen, _ = one.reset()
        last, ended = 0.0, False
        while not ended:
            seen, _, fallen, truncated, info = one.step(model.predict(seen, deterministic=True)[0])
            ended = fallen or truncated
            if not fallen:
                last = (info["x"] - task.creature.mesh.vertices)[:, 0].mean() / task.length
        records.append(Record(model.num_timesteps, time.perf_counter() - began, float(last), 0))
    return records


def measure_biped(*, data: Path = Path("creatures.npz")) -> Numbers:
    """How far the published biped walks in 2,000 steps, and how often it falls from perturbed starts.

    Args:
        data: file with the arrays biped_vertices, biped_triangles, biped_muscles and those of biped_policy_.
    """
    arrays = load_file(data, lambda arrays: arrays, KEYS)
    if missing := [key for key in KEYS if key not in arrays]:
        raise InputError(f"{data}: {missing[0]} is missing; expected the published biped with its policy")
    walked = float(shown_walk(*published_biped(arrays), STEPS).travelled.sum())
    numbers = {
        "published-biped/rest": {"distance_body_lengths": walked, "relative_difference": abs(walked / BIPED - 1)}
    }
    for name, slope in (("flat", 0.0), ("slope-10", 10.0)):
        biped = published_biped(arrays, variation=Variation(start=0.01, slope=slope))
        numbers[f"published-biped/{name}"] = numbers_of(perturbed_trials(*biped))
    return numbers


def published_biped(
    arrays: Mapping[str, np.ndarray], *, variation: Variation = FLAT
) -> tuple[LocomotionTask, Policy, Parameters]:
    """The biped and the policy of J. Rojas (algovivo) as a task, a policy and its parameters.

        change = clip(tanh(W2 relu(W1 ((x - x_c) Rᵀ, v Rᵀ) + b1) + b2), -0.3, 0.3)

    x_c is the centre vertex, and the first row of R points from it to the forward vertex.
    """
    vertices, triangles, muscles, *weights, centre, forward = (arrays[key] for key in KEYS)
    # Origin and axis are those of two vertices.
    at_centre, at_forward = np.eye(len(vertices))[[int(centre), int(forward)]]
    frame = Frame(at_centre, (at_forward - at_centre)[None])
    creature = Creature("published-biped", make_mesh(vertices, triangles), muscles)
    task = make_task(creature, frame=frame, variation=variation, clock_period=0.0)
    a = vertices[int(forward)] - vertices[int(centre)]
    a = a / np.linalg.norm(a)
    rest = (vertices - vertices[int(centre)]) @ np.array([[a[0], -a[1]], [a[1], a[0]]])
    count = rest.size

    def apply(parameters, seen):
        w1, b1, w2, b2 = parameters
        x, v = seen[:count] * (POSITION_UNIT * task.length) + rest.ravel(), seen[count : 2 * count] * task.length
        return jnp.tanh(w2 @ jax.nn.relu(w1 @ jnp.concatenate([x, v]) + b1) + b2)

    parameters = tuple(jnp.asarray(weight) for weight in weights)
    return task, Policy(lambda _: parameters, apply), parameters


CASES = (
    Case(
        "comparison/crawler",
        measure_comparison,
        quick={"seeds": 1, "steps": 1_280, "rivals": ()},
        bound={
            "crawler/gradient seconds_to_five_body_lengths": 60.0,
            "crawler/ppo environment_steps_ratio_to_gradient": AtLeast(3.0),
        },
    ),
    Case(
        "published/biped",
        measure_biped,
        published={"distance_body_lengths": BIPED},
        bound={"relative_difference": 0.02},
        by_name_only=True,
    ),
)
