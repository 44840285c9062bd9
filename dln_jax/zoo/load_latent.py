"""A trained model of pictures as jitted functions: its autoencoder, and what moves in the latent plane."""

import reprlib
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.files import matches
from dln_jax.mechanics.arguments import vectors
from dln_jax.models.latent_phase import LatentModel, LatentPhase, latent_field, make_latent_phase, through_components
from dln_jax.models.model import Parameters
from dln_jax.models.principal_components import Components
from dln_jax.types import InputError
from dln_jax.zoo.load import MODEL, compiled
from dln_jax.zoo.parameter_files import REMEDY, load_manifest, load_tree, save_tree

KIND = "latent-phase"
MOST_NUMBERS = 10**8
"""Of the components of a picture."""


class PictureModels(NamedTuple):
    """One model with one set of parameters, from two sides."""

    of_coefficients: LatentModel
    """Of the pictures' principal components, which is trained."""
    of_pictures: LatentModel


def build_latent(field: str, components: Components) -> PictureModels:
    """The model of pictures with a "hnn" or a "baseline" in its latent plane."""
    mean = np.zeros(2 * len(components.basis))
    inner = make_latent_phase(latent_field(field), mean, framewise=True, scale=components.scale)
    return PictureModels(inner, through_components(inner, components))


def save_latent(directory: Path, field: str, components: Components, parameters: Parameters) -> None:
    """Writes `model.safetensors` and `model.json` into an existing folder."""
    count, pixels = components.basis.shape
    facts = {"kind": KIND, "field": field, "components": count, "pixels": pixels, "precision": "f32"}
    arrays = {"mean": components.mean, "basis": components.basis, "scale": np.array(components.scale)}
    save_tree(directory, MODEL, {"parameters": parameters, "components": arrays}, {"model": facts})


def load_latent(directory: str | Path) -> LatentPhase:
    """The jitted functions of a run of train_hnn --task pixels, its parameters closed over.

    Raises:
        InputError: no such model in the folder, or one that is damaged, altered or of another schema.
    """
    directory = Path(directory)
    facts = load_manifest(directory, MODEL).get("model")
    if not isinstance(facts, dict) or facts.get("kind") != KIND:
        raise InputError(f"{directory / MODEL}.json: describes no {KIND}; give the folder of a run of --task pixels")
    for key in ("pixels", "components"):
        if not matches(facts.get(key), int) or facts[key] < 1:
            raise InputError(f"{directory / MODEL}.json: {key} is {reprlib.repr(facts.get(key))}; {REMEDY}")
    if not isinstance(facts.get("field"), str) or facts["components"] * facts["pixels"] > MOST_NUMBERS:
        raise InputError(f"{directory / MODEL}.json: describes no field, or one of too many pixels; {REMEDY}")
    empty = Components(np.zeros(facts["pixels"]), np.zeros((facts["components"], facts["pixels"])), 1.0, 0.0)
    like = {
        "parameters": jax.eval_shape(build_latent(facts["field"], empty).of_pictures.init, jax.random.key(0)),
        "components": {"mean": empty.mean, "basis": empty.basis, "scale": np.array(1.0)},
    }
    stored = load_tree(directory, MODEL, like)
    mean, basis, scale = (np.asarray(stored["components"][key]) for key in ("mean", "basis", "scale"))
    model = build_latent(facts["field"], Components(mean, basis, float(scale), 0.0)).of_pictures
    system = model.apply(stored["parameters"])

    def single(size, **given):
        return (array.astype(jnp.float32) for array in vectors(size, **given))

    return LatentPhase(
        jax.jit(lambda frames: system.encode(*single(2 * facts["pixels"], frames=frames))),
        jax.jit(lambda q, p: system.decode(*single(1, q=q, p=p))),
        compiled(system.field, jnp.float32),
    )
