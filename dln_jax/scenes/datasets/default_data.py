"""Default dataset of the scripts: generated once, then read from the cache."""

from dln_jax.data import schema
from dln_jax.data.schema import Trajectories
from dln_jax.files import cache_folder
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.scene import Scene

CHARACTERS_TEST = ("e", "q", "v")
"""Test letters of the published protocol."""

_VERSION = 1  # of the generators' output; a new version makes a new file instead of reading a stale one


def default_data(scene: Scene) -> Trajectories:
    """Letters for the two-link arm; random states, which exercise every term, for any other scene."""
    kind = "characters" if scene.name == "two-link-arm" else "uniform"
    path = cache_folder() / f"{scene.name}-{kind}-{_VERSION}.npz"
    if not path.exists():
        data = generators.characters() if kind == "characters" else generators.uniform(scene)
        schema.save(path, data, overwrite=True)  # safe if two processes generate at the same time: one rename wins
    return schema.load(path)
