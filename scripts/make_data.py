"""Generate trajectories of a textbook scene, with exact rates, torques and force decomposition, as an npz file.

Kinds: `characters` (the two-link arm writes 20 letters), `uniform` (independent random states in a box), and
`free-swing` (motions from rest without torque, integrated to 1e-10).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dln_jax.data import generators, schema
from dln_jax.data.schema import Trajectories
from dln_jax.types import InputError
from scripts.command_line import run, scene_named


@dataclass(frozen=True)
class Arguments:
    """What to generate."""

    out: Path
    """File to write; its name ends in .npz."""
    scene: str = "two-link-arm"
    """two-link-arm, two-link-arm-hanging, pendulum, double-pendulum, cart-pole, or chain-1 to chain-12."""
    kind: Literal["characters", "uniform", "free-swing"] = "characters"
    """How to sample the scene."""
    samples: int = 3000
    """States of the uniform kind."""
    position_bound: float = 3.141592653589793
    """Uniform kind: half the box of q, rad or m."""
    rate_bound: float = 5.0
    """Uniform kind: half the box of qd, 1/s."""
    acceleration_bound: float = 20.0
    """Uniform kind: half the box of qdd, 1/s² (fully actuated scenes)."""
    control_bound: float = 10.0
    """Uniform kind: half the box of the controls, N m or N (under-actuated scenes)."""
    trajectories: int = 10
    """Motions of the free-swing kind."""
    steps: int = 400
    """Free-swing kind: samples per motion."""
    dt: float | None = None
    """Time between samples, s (default 0.04 for characters, 0.02 for free-swing)."""
    seed: int = 0
    """Of everything that is drawn."""
    overwrite: bool = False
    """Replace the file if it exists."""


def main(given: Arguments) -> None:
    """Generates, writes and says what was written."""
    data = generate(given)
    schema.save(given.out, data, overwrite=given.overwrite)
    count = len(set(data.trajectory.tolist()))
    print(f"{given.out}: {len(data.t)} samples of {count} trajectories, {data.degrees_of_freedom} degrees of freedom")


def generate(given: Arguments) -> Trajectories:
    """The trajectories that the arguments ask for."""
    scene = scene_named(given.scene)
    if given.kind == "characters":
        if scene.name != "two-link-arm":
            raise InputError(f"characters are written by the two-link-arm, not by {scene.name}; choose another --kind")
        return generators.characters(dt=0.04 if given.dt is None else given.dt)
    if given.kind == "uniform":
        return generators.uniform(
            scene,
            samples=given.samples,
            position_bound=given.position_bound,
            rate_bound=given.rate_bound,
            acceleration_bound=given.acceleration_bound,
            control_bound=given.control_bound,
            seed=given.seed,
        )
    return generators.free_swing(
        scene,
        trajectories=given.trajectories,
        steps=given.steps,
        dt=0.02 if given.dt is None else given.dt,
        seed=given.seed,
    )


if __name__ == "__main__":
    run(main, Arguments)
