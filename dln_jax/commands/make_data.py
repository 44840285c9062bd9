"""Generate trajectories of a textbook scene, with exact rates, torques and force decomposition, as an npz file.

Kinds: `characters` (the two-link arm writes 20 letters), `uniform` (independent random states in a box), and
`free-swing` (motions from rest without torque, integrated to 1e-10).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from dln_jax.errors import InputError
from dln_jax.runs.arguments import Unstated, refuse_given
from dln_jax.runs.options import SceneName

OF_KIND = {
    "characters": ("dt",),
    "uniform": ("samples", "position_bound", "rate_bound", "acceleration_bound", "control_bound", "seed"),
    "free-swing": ("trajectories", "steps", "dt", "seed"),
}
"""Options of each kind; unset options take the generator's defaults."""


@dataclass(frozen=True)
class Arguments:
    """What to generate, and where it goes."""

    out: Path
    """File to write; its name ends in .npz."""
    scene: SceneName = "two-link-arm"
    """The textbook system."""
    kind: Literal["characters", "uniform", "free-swing"] = "characters"
    """How to sample the scene."""
    samples: Unstated[int] = None
    """uniform: number of states (default: 3000)."""
    position_bound: Unstated[float] = None
    """uniform: largest |q|, rad or m (default: pi)."""
    rate_bound: Unstated[float] = None
    """uniform: largest |qd|, 1/s (default: 5)."""
    acceleration_bound: Unstated[float] = None
    """uniform, fully actuated scenes: largest |qdd|, 1/s² (default: 20)."""
    control_bound: Unstated[float] = None
    """uniform, under-actuated scenes: largest control, N m or N (default: 10)."""
    trajectories: Unstated[int] = None
    """free-swing: number of motions (default: 10)."""
    steps: Unstated[int] = None
    """free-swing: samples per motion (default: 400)."""
    dt: Unstated[float] = None
    """characters, free-swing: time between samples, s (default: 0.04 for characters, 0.02 for free-swing)."""
    seed: Unstated[int] = None
    """uniform, free-swing: seed of all random numbers (default: 0)."""
    overwrite: bool = False
    """Replace the file if it exists."""


def main(options: Arguments) -> None:
    """Generates the trajectories, writes them and prints a summary."""
    from dln_jax.data import schema

    data = generate(options)
    schema.save(options.out, data, overwrite=options.overwrite)
    count = len(set(data.trajectory.tolist()))
    print(f"{options.out}: {len(data.t)} samples of {count} trajectories, {data.degrees_of_freedom} degrees of freedom")


def generate(options: Arguments) -> Any:
    """Generates the requested trajectories; `InputError` for options that the kind or the scene does not use."""
    from dln_jax.scenes.datasets import generators
    from dln_jax.scenes.registry import scene_named

    scene = scene_named(options.scene)
    unused = {name for names in OF_KIND.values() for name in names} - set(OF_KIND[options.kind])
    refuse_given(options, sorted(unused), f"not used for --kind {options.kind}")
    chosen = {name: getattr(options, name) for name in OF_KIND[options.kind] if getattr(options, name) is not None}
    if options.kind == "characters":
        if scene.name != "two-link-arm":
            raise InputError(f"characters are written by the two-link-arm, not by {scene.name}; choose another --kind")
        return generators.characters(**chosen)
    if options.kind == "uniform":
        actuated = scene.needs.actuation is None
        refuse_given(options, ["control_bound" if actuated else "acceleration_bound"], f"not used for {options.scene}")
        return generators.uniform(scene, **chosen)
    return generators.free_swing(scene, **chosen)
