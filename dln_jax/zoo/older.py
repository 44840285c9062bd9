"""What release 0.1.0 wrote (schema version 1), in the words of this one: old names, and the keywords it left out.

The table is written out and never read from a factory, so that no change of a default changes a stored model. A keyword
that a factory gains gets here the value that leaves its model as it was.
"""

import reprlib
from typing import Any

import numpy as np

from dln_jax.types import InputError

VERSION = 1
FRICTION = {"friction_width": 0, "friction_depth": 1, "friction_activation": "tanh", "initial_friction": 0.05}
STRUCTURED_HNN = {"width": 64, "depth": 2, "diagonal_shift": 0.0, "diagonal_floor": 0.1, **FRICTION}
ONE_NETWORK = {"width": 64, "depth": 2, "momentum_scale": 1.0, "iterations": 8, "initial_guess": None, **FRICTION}
KINDS: dict[str, tuple[str, dict[str, Any]]] = {
    "structured-delan": (
        "structured-delan",
        {"width": 64, "depth": 2, "diagonal_shift": 2.0, "diagonal_floor": 0.1, "shared_trunk": False},
    ),
    "black-box-delan": ("black-box-delan", {"width": 64, "depth": 2, "rate_scale": 1.0}),
    "trigonometric": ("trigonometric", {"degree": 1}),
    "feed-forward": (
        "feed-forward",
        {"width": 64, "depth": 2, "rate_scale": 1.0, "acceleration_scale": 1.0, "tau_scale": 1.0},
    ),
    "structured-hnn": ("structured-hnn", STRUCTURED_HNN),
    "structured-hamiltonian": ("structured-hnn", STRUCTURED_HNN),
    "black-box-hnn": ("black-box-hnn", ONE_NETWORK),
    "black-box-hamiltonian": ("black-box-hnn", ONE_NETWORK),
    "separable-hamiltonian": ("separable-hnn", ONE_NETWORK),
    "pairwise-hamiltonian": (
        "pairwise-hnn",
        {
            **{"dimension": 2, "order": "bodies", "alike": True, "distance_scale": 1.0, "width": 32, "depth": 2},
            "features": ["distance", "inverse", "logarithm"],
        },
    ),
    "polynomial-hamiltonian": ("polynomial-hamiltonian", {"degree": 2}),
    "phase-network": ("phase-network", {"width": 64, "depth": 2, "momentum_scale": 1.0, "rate_scale": 1.0}),
    "differential-mlp": ("differential-network", {}),
    "latent-phase": (
        "latent-phase",
        {
            **{"field_width": 64, "field_depth": 2, "field_activation": "tanh"},
            **{"width": 200, "activation": "silu", "momentum_scale": 0.2},
        },
    ),
}
"""By the old kind: the name, and the defaults that were not stored."""
NEEDS = {"gravity": True, "friction": False, "actuation": None}
FIELDS = {"hnn": "black-box-hnn", "baseline": "phase-network"}
"""Of the latent plane."""


def upgraded(description: dict[str, Any]) -> dict[str, Any]:
    """The description of this release for one of schema version 1.

    Raises:
        InputError: a kind that 0.1.0 did not know.
    """
    stored = dict(description)
    kind = stored.pop("kind", None)
    if not isinstance(kind, str) or kind not in KINDS:
        raise InputError(f"model kind is {reprlib.repr(kind)}; release 0.1.0 knew {', '.join(KINDS)}")
    name, defaults = KINDS[kind]
    if isinstance(stored.get("needs"), dict):
        stored["needs"] = {**NEEDS, **stored["needs"]}
    if kind == "latent-phase" and isinstance(stored.get("field"), str):
        stored["field"] = FIELDS.get(stored["field"], stored["field"])
    return {"name": name, **defaults, **stored}


def stored_types(like: Any) -> Any:
    """The tree of a model as schema version 1 has it on disk: the components of pictures in float64."""
    if not isinstance(like, dict) or "components" not in like:
        return like
    wide = {name: np.broadcast_to(np.float64(0), leaf.shape) for name, leaf in like["components"].items()}
    return {**like, "components": wide}
