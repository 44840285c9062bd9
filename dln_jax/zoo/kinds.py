"""The models of the zoo by name, for command lines and for files: what a name builds, and what it is fitted to.

A description is plain JSON values: `kind`, `needs`, `precision` (f32 or f64), and the keywords of the kind's factory.
"""

import reprlib
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple, TypeVar

from dln_jax.data.magnitudes import spread
from dln_jax.data.schema import Trajectories, needs_from_json
from dln_jax.files import matches
from dln_jax.models.black_box import make_black_box_lagrangian
from dln_jax.models.delan import make_delan
from dln_jax.models.feed_forward import make_feed_forward
from dln_jax.models.hamiltonian import make_black_box_hamiltonian, make_structured_hamiltonian
from dln_jax.models.model import Model
from dln_jax.models.trigonometric import make_trigonometric
from dln_jax.nn.activations import activation
from dln_jax.precision import data_type
from dln_jax.types import InputError, Needs, require_network
from dln_jax.zoo.parameter_files import REMEDY

FittedTo = Literal["torque", "canonical", "both ways"]
"""Torques; velocities and accelerations of a Hamiltonian; torques and accelerations."""

SomeKind = TypeVar("SomeKind")
SomeModel = TypeVar("SomeModel")


class Kind(NamedTuple):
    """A kind of model."""

    make: Callable[..., Model]
    """(needs, **keywords) -> model."""
    fitted_to: FittedTo
    """What it is fitted to, where the data have it; else torques."""
    scales: dict[str, str]
    """Keywords that are typical sizes, and the data array whose standard deviation each is."""


KINDS = {
    "structured-delan": Kind(make_delan, "torque", {}),
    "black-box-delan": Kind(make_black_box_lagrangian, "torque", {"rate_scale": "qd"}),
    "structured-hnn": Kind(make_structured_hamiltonian, "canonical", {}),
    "black-box-hnn": Kind(make_black_box_hamiltonian, "canonical", {"momentum_scale": "p"}),
    "feed-forward": Kind(
        make_feed_forward, "both ways", {"rate_scale": "qd", "acceleration_scale": "qdd", "tau_scale": "tau"}
    ),
    "trigonometric": Kind(make_trigonometric, "torque", {}),
}


def describe(kind: str, data: Trajectories, needs: Needs, *, precision: str, **keywords: Any) -> dict[str, Any]:
    """The description of a model for these training data: typical sizes are theirs, to three digits.

    Raises:
        InputError: numbers so large or small that their squares are infinite or zero.
    """
    scales = {}
    for name, key in KINDS[kind].scales.items():
        array = getattr(data, key)
        if array is not None:
            deviation = spread(key, array)
            scales[name] = [float(f"{size:.3g}") if size > 0 else 1.0 for size in deviation]
    return {"kind": kind, "needs": needs._asdict(), "precision": precision, **keywords, **scales}


def build(description: dict[str, Any]) -> Model:
    """The model that a description stands for.

    Raises:
        InputError: an unknown kind, needs, activation or precision, or a missing or unknown key.
    """
    return build_by(description, KINDS, lambda kind, *given, **keywords: kind.make(*given, **keywords))


PLAIN = ("needs", "features")
"""Keys of a description that are no numbers, names or switches; whoever reads them checks them."""
STATED: dict[str, type] = {
    **dict.fromkeys(("precision", "activation"), str),
    **dict.fromkeys(("width", "depth", "degree", "dimension", "friction_width", "iterations"), int),
    **dict.fromkeys(("shared_trunk", "alike"), bool),
}
"""Types of the other keys; those that are not here are numbers. Scales and degrees: one for all, or one each."""
WITHOUT_ACTIVATION = ("trigonometric", "polynomial-hamiltonian")
"""Kinds that are no networks."""


def build_by(description: dict[str, Any], kinds: Mapping[str, SomeKind], make: Callable[..., SomeModel]) -> SomeModel:
    """What `make(kind, needs, dtype=..., **keywords)` gives for a description of one of these kinds.

    Raises:
        InputError: as `build`.
    """
    keywords = dict(description)
    kind = keywords.pop("kind", None)
    if not isinstance(kind, str) or kind not in kinds:
        raise InputError(f"model kind is {reprlib.repr(kind)}; this release knows {', '.join(kinds)}")
    for key, value in keywords.items():
        several = isinstance(value, list | tuple) and (key.endswith("_scale") or key == "degree")
        numbers = value if several else [value]
        if key not in PLAIN and not all(matches(each, STATED.get(key, float)) for each in numbers):
            wanted = STATED.get(key, float).__name__
            raise InputError(f"model description: {key} is {reprlib.repr(value)}, expected {wanted}; {REMEDY}")
    if "width" in keywords or "depth" in keywords:
        require_network(width=keywords.get("width", 1), depth=keywords.get("depth", 1))
    try:
        needs, dtype = needs_from_json(keywords.pop("needs")), data_type(keywords.pop("precision"))
        if kind not in WITHOUT_ACTIVATION:
            keywords["activation"] = activation(keywords.pop("activation"))
        # JSON knows no tuples, and a model's keywords are hashable.
        keywords = {key: tuple(value) if isinstance(value, list) else value for key, value in keywords.items()}
        return make(kinds[kind], needs, dtype=dtype, **keywords)
    except InputError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"model description: {error}; a release that is newer or older may have written it") from error
