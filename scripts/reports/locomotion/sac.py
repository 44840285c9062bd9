"""Soft actor-critic (Haarnoja et al. 2018) by stable-baselines3, whose actor becomes a policy of dln_jax.

The actor is a network of two layers of rectified linear units; the tanh of its mean is the command of the muscles.
"""

import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jaxtyping import Array, Float

from dln_jax.locomotion.gradient import Report, TrainedPolicies, learn_seeds
from dln_jax.locomotion.learning import LANES, CompiledLearner, Goal, Learner, Parameters, Policy, compile_evaluation
from dln_jax.locomotion.task import LocomotionTask, actuation_seen, change_of
from dln_jax.scale.mesh import shares
from dln_jax.softbody.terms.creature import TIME_STEP
from scripts.reports.locomotion.ppo import layers_of, make_actor, require_stable_baselines3

_ACTOR = ("latent_pi.0", "latent_pi.2", "mu")


class SACSettings(NamedTuple):
    """Hyperparameters; the same for all creatures and seeds."""

    lanes: int = 16
    steps: int = 80
    """Steps of each lane between two evaluations."""
    batch: int = 256
    updates: int = 8
    """Gradient steps after every step of all lanes."""
    learning_rate: float = 3e-4
    discount: float = 0.98
    following: float = 0.02
    """tau, share of the critics that their copies take over in an update."""
    temperature: float = 0.01
    """Initial weight of the entropy, which is adapted."""
    coherent: int = 0
    """Steps after which the noise of the actions, a function of the state (gSDE), is drawn anew; 0 for white noise."""
    first: int = 2000
    """Environment steps of random actions."""
    width: int = 128
    """Units of the two hidden layers of actor and critics."""


STEPS = 20_000
"""Environment steps by default."""


def settings_of(lanes: int | None) -> SACSettings:
    """Returns the settings, with another number of lanes if it is stated."""
    return SACSettings() if lanes is None else SACSettings(lanes=lanes)


def check(lanes: int | None, mesh: Mesh | None) -> None:
    """Raises `InputError` if stable-baselines3 is not installed, or if the mesh does not divide the lanes."""
    require_stable_baselines3("sac")
    shares(mesh, settings_of(lanes).lanes, f"{LANES} (--lanes)")


def train_by_sac(
    task: LocomotionTask, seeds: Sequence[int], goal: Goal, report: Report, *, lanes: int | None, mesh: Mesh | None
) -> TrainedPolicies:
    """Learns with several seeds, without checkpoints; arguments as for `dln_jax.locomotion.train`."""
    return learn_seeds(compile_sac(task, settings_of(lanes), mesh=mesh), seeds, goal, report)


def make_squashed_actor(task: LocomotionTask) -> Policy:
    """Returns the actor's most likely action as a policy; parameters are those of `ppo.make_actor`."""

    def apply(parameters: Parameters, observation: Float[Array, " o"]) -> Float[Array, " k"]:
        h, (*hidden, last) = observation.astype(parameters[0]["w"].dtype), parameters
        for layer in hidden:
            h = jax.nn.relu(layer["w"] @ h + layer["b"])
        command = jnp.tanh(last["w"] @ h + last["b"]).astype(observation.dtype)
        return change_of(actuation_seen(task, observation), command)

    return Policy(make_actor(task).init, apply)


def compile_sac(
    task: LocomotionTask,
    settings: SACSettings = SACSettings(),  # noqa: B008
    *,
    mesh: Mesh | None = None,
) -> CompiledLearner:
    """Returns the learner with its programs, as `ppo.compile_ppo` does.

    Raises:
        InputError: stable-baselines3 is not installed, or a mesh that does not divide the lanes.
    """
    require_stable_baselines3("sac")
    import torch  # pyright: ignore[reportMissingImports]
    from stable_baselines3 import SAC  # pyright: ignore[reportMissingImports]

    from scripts.reports.locomotion.vector_environment import VectorEnvironment

    began = time.perf_counter()
    torch.set_num_threads(1)
    lanes = VectorEnvironment(task, settings.lanes, reward_scale=1.0 / TIME_STEP, mesh=mesh)

    def start(seed: int) -> Any:
        return SAC(
            "MlpPolicy",
            lanes,
            batch_size=settings.batch,
            gradient_steps=settings.updates,
            learning_rate=settings.learning_rate,
            gamma=settings.discount,
            tau=settings.following,
            learning_starts=settings.first,
            ent_coef=f"auto_{settings.temperature}",
            use_sde=settings.coherent > 0,
            sde_sample_freq=settings.coherent or -1,
            buffer_size=300_000,
            policy_kwargs={"net_arch": [settings.width] * 2, "clip_mean": 0.0},
            seed=seed,
            device="cpu",
        )

    def improve(model: Any) -> Any:
        return model.learn(steps, reset_num_timesteps=model.num_timesteps == 0)

    def parameters(model: Any) -> Parameters:
        return layers_of(model.actor, _ACTOR)

    steps, actor = settings.steps * settings.lanes, make_squashed_actor(task)
    learner = Learner(actor, start, improve, parameters, steps, skipped=lambda model: 0)
    evaluate = compile_evaluation(task, actor, parameters(start(0)), mesh)
    return CompiledLearner(learner, improve, evaluate, time.perf_counter() - began)
