"""Generate trajectories of a textbook system as npz.

The file has exact rates, torques and a decomposition of the forces. Kinds: `characters` (the two-link arm writes 20
letters), `uniform` (independent random states in a box), and `free-swing` (motions from rest without torque, integrated
to 1e-10).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dln_jax.errors import InputError
from dln_jax.options import SceneName, Unstated
from dln_jax.runs.arguments import refuse_given

OF_KIND = {"characters": ("dt",), "uniform": ("samples", "seed"), "free-swing": ("trajectories", "steps", "dt", "seed")}
"""Options of each kind; unset options take the generator's defaults."""


@dataclass(frozen=True)
class Arguments:
    """What to generate, and where it goes."""

    out: Path
    """File to write; its name ends in .npz."""
    scene: SceneName = "two-link-arm"
    """Textbook system."""
    kind: Literal["characters", "uniform", "free-swing"] = "characters"
    """How to sample the scene."""
    samples: Unstated[int] = None
    """uniform: number of states (default: 3000)."""
    trajectories: Unstated[int] = None
    """free-swing: number of motions (default: 10)."""
    steps: Unstated[int] = None
    """free-swing: samples per motion (default: 400)."""
    dt: Unstated[float] = None
    """characters, free-swing: time between samples, s (default: 0.04 for characters, 0.02 for free-swing)."""
    seed: Unstated[int] = None
    """uniform, free-swing: seed for all random numbers (default: 0)."""
    overwrite: bool = False
    """Replace the file if it exists."""


def main(options: Arguments) -> None:
    """Generates the trajectories, writes them and prints a summary."""
    from dln_jax.data import schema
    from dln_jax.scenes.datasets import generators
    from dln_jax.scenes.registry import scene_named

    if options.out.exists() and not options.overwrite:
        raise InputError(f"{options.out} already exists; choose another --out, or add --overwrite")
    scene, kind = scene_named(options.scene), options.kind
    unused = {name for names in OF_KIND.values() for name in names} - set(OF_KIND[kind])
    refuse_given(options, sorted(unused), f"not used for --kind {kind}")
    chosen = {name: value for name in OF_KIND[kind] if (value := getattr(options, name)) is not None}
    if kind == "uniform":
        data = generators.uniform(scene, **chosen)
    elif kind == "free-swing":
        data = generators.free_swing(scene, **chosen)
    elif scene.name == "two-link-arm":
        data = generators.characters(**chosen)
    else:
        raise InputError(f"characters are written by the two-link-arm, not by {scene.name}; choose another --kind")
    schema.save(options.out, data, overwrite=options.overwrite)
    count = len(set(data.trajectory.tolist()))
    print(f"{options.out}: {len(data.t)} samples of {count} trajectories, {data.degrees_of_freedom} degrees of freedom")
