"""Proximal policy optimisation (Schulman et al. 2017) by stable-baselines3, whose actor becomes a policy of dln_jax.

The actor is a network of two tanh layers; its mean in [-1, 1] is the command of the muscles.
"""

import importlib.util
import math
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax.sharding import Mesh
from jaxtyping import Array, Float

from dln_jax.locomotion.gradient import Report, TrainedPolicies, learn_seeds
from dln_jax.locomotion.learning import LANES, CompiledLearner, Goal, Learner, Parameters, Policy, compile_evaluation
from dln_jax.locomotion.task import LocomotionTask, actuation_seen, change_of
from dln_jax.scale.mesh import shares
from dln_jax.softbody.terms.creature import TIME_STEP
from dln_jax.types import InputError

_ACTOR = ("mlp_extractor.policy_net.0", "mlp_extractor.policy_net.2", "action_net")


class PPOSettings(NamedTuple):
    """Hyperparameters; the same for all creatures and seeds."""

    lanes: int = 16
    steps: int = 80
    """Steps of each lane between two updates."""
    batch: int = 256
    epochs: int = 10
    learning_rate: float = 1e-3
    discount: float = 0.98
    trace: float = 0.95
    """lambda of generalised advantage estimation."""
    clip: float = 0.2
    entropy: float = 0.0
    """Weight of the entropy bonus."""
    deviation: float = 0.6
    """Standard deviation of the first actions."""
    width: int = 64
    """Units of the two hidden layers of actor and critic."""


STEPS = 300_000
"""Environment steps by default."""


def settings_of(lanes: int | None) -> PPOSettings:
    """Returns the settings, with another number of lanes if it is stated."""
    return PPOSettings() if lanes is None else PPOSettings(lanes=lanes)


def check(lanes: int | None, mesh: Mesh | None) -> None:
    """Raises `InputError` if stable-baselines3 is not installed, or if the mesh does not divide the lanes."""
    require_stable_baselines3()
    shares(mesh, settings_of(lanes).lanes, f"{LANES} (--lanes)")


def train_by_ppo(
    task: LocomotionTask, seeds: Sequence[int], goal: Goal, report: Report, *, lanes: int | None, mesh: Mesh | None
) -> TrainedPolicies:
    """Learns with several seeds, without checkpoints; arguments as for `dln_jax.locomotion.train`."""
    return learn_seeds(compile_ppo(task, settings_of(lanes), mesh=mesh), seeds, goal, report)


def require_stable_baselines3() -> None:
    """Raises `InputError` if stable-baselines3 is not installed."""
    if importlib.util.find_spec("stable_baselines3") is None:
        raise InputError("ppo needs stable-baselines3; install it by: pip install 'dln-jax[rl]'")


def make_actor(task: LocomotionTask) -> Policy:
    """Returns the actor's mean as a policy; parameters are "w" and "b" of the layers, and `init` raises."""

    def apply(parameters: Parameters, observation: Float[Array, " o"]) -> Float[Array, " k"]:
        h, (*hidden, last) = observation.astype(parameters[0]["w"].dtype), parameters
        for layer in hidden:
            h = jnp.tanh(layer["w"] @ h + layer["b"])
        command = jnp.clip(last["w"] @ h + last["b"], -1.0, 1.0).astype(observation.dtype)
        return change_of(actuation_seen(task, observation), command)

    def init(key: Array) -> Parameters:
        sizes = task.observation_size, task.muscle_count
        raise InputError(f"an actor of {sizes} is trained by stable-baselines3, which initialises it")

    return Policy(init, apply)


def actor_parameters(model: Any) -> Parameters:
    """Returns the parameters of `make_actor` from a stable-baselines3 model."""
    stored = model.policy.state_dict()
    return tuple(
        {"w": jnp.asarray(stored[f"{name}.weight"].numpy()), "b": jnp.asarray(stored[f"{name}.bias"].numpy())}
        for name in _ACTOR
    )


def compile_ppo(
    task: LocomotionTask,
    settings: PPOSettings = PPOSettings(),  # noqa: B008
    *,
    mesh: Mesh | None = None,
) -> CompiledLearner:
    """Returns the learner with its programs; an update takes `settings.steps` steps of every lane.

    Devices of a mesh share the lanes. All processes train the networks identically, because they see the same lanes and
    draw the same numbers.

    Raises:
        InputError: stable-baselines3 is not installed, or a mesh that does not divide the lanes.
    """
    require_stable_baselines3()
    import torch  # pyright: ignore[reportMissingImports]
    from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]

    from scripts.reports.locomotion.vector_environment import VectorEnvironment

    began = time.perf_counter()
    # Networks of this size are slower on several threads.
    torch.set_num_threads(1)
    # Rewards in body lengths per second, a scale that suits the critic.
    lanes = VectorEnvironment(task, settings.lanes, reward_scale=1.0 / TIME_STEP, mesh=mesh)

    def start(seed: int) -> Any:
        return PPO(
            "MlpPolicy",
            lanes,
            n_steps=settings.steps,
            batch_size=settings.batch,
            n_epochs=settings.epochs,
            learning_rate=settings.learning_rate,
            gamma=settings.discount,
            gae_lambda=settings.trace,
            clip_range=settings.clip,
            ent_coef=settings.entropy,
            policy_kwargs={"net_arch": [settings.width] * 2, "log_std_init": math.log(settings.deviation)},
            seed=seed,
            device="cpu",
        )

    def improve(model: Any) -> Any:
        return model.learn(steps, reset_num_timesteps=model.num_timesteps == 0)

    steps, actor = settings.steps * settings.lanes, make_actor(task)
    learner = Learner(actor, start, improve, actor_parameters, steps, skipped=lambda model: 0)
    evaluate = compile_evaluation(task, actor, actor_parameters(start(0)), mesh)
    return CompiledLearner(learner, improve, evaluate, time.perf_counter() - began)
