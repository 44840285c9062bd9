"""The models of a phase space by name, for command lines and for files: what a name builds.

A description is plain JSON values: `kind`, `needs`, `precision` (f32 or f64), and the keywords of the kind's factory.
Where the needs state friction, `friction_width` asks for a friction that depends on q; without it, a Hamiltonian has
one coefficient per coordinate. Each is absent where the needs have none.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from dln_jax.data.magnitudes import spread
from dln_jax.data.schema import Trajectories
from dln_jax.models.dissipative import make_dissipative
from dln_jax.models.hamiltonian import make_black_box_hamiltonian, make_structured_hamiltonian
from dln_jax.models.model import Model
from dln_jax.models.n_body import make_pairwise_hamiltonian
from dln_jax.models.phase_network import make_phase_network
from dln_jax.models.polynomial_hamiltonian import make_polynomial_hamiltonian
from dln_jax.models.separable import make_separable_hamiltonian
from dln_jax.types import InputError, Needs
from dln_jax.zoo.kinds import build_by


def _pairwise(needs: Needs, *, dimension: int = 2, **keywords: Any) -> Model:
    if set(needs.joints) != {"prismatic"} or needs.degrees_of_freedom % dimension or needs.friction:
        raise InputError(
            f"the pairwise model takes positions of bodies, {dimension} for each, without friction; it got {needs}"
        )
    return make_pairwise_hamiltonian(needs.degrees_of_freedom // dimension, dimension, **keywords)


class PhaseKind(NamedTuple):
    """A kind of model."""

    energy: Callable[..., Model] | None
    """(needs, **keywords) -> Hamiltonian model; `None` for a kind that is no network of an energy."""
    field: Callable[..., Model] | None
    """(needs, **keywords) -> phase model, where there is no `energy`."""
    scales: tuple[str, ...] = ()
    """Keywords that are typical sizes, taken from the data."""


PHASE_KINDS = {
    "separable-hamiltonian": PhaseKind(make_separable_hamiltonian, None, ("momentum_scale",)),
    "structured-hamiltonian": PhaseKind(make_structured_hamiltonian, None),
    "black-box-hamiltonian": PhaseKind(make_black_box_hamiltonian, None, ("momentum_scale",)),
    "pairwise-hamiltonian": PhaseKind(_pairwise, None),
    "polynomial-hamiltonian": PhaseKind(None, make_polynomial_hamiltonian),
    "phase-network": PhaseKind(None, make_phase_network, ("momentum_scale", "rate_scale")),
}


def describe_phase(
    kind: str, data: Trajectories, needs: Needs, *, precision: str = "f64", **keywords: Any
) -> dict[str, Any]:
    """The description of a model for these training data: typical sizes are theirs, to three digits.

    Raises:
        InputError: an unknown kind, no momenta in the data where their size is needed, or numbers whose squares are
            infinite or zero.
    """
    if kind not in PHASE_KINDS:
        raise InputError(f"model kind is {kind!r}; this release knows {', '.join(PHASE_KINDS)}")
    arrays = {"momentum_scale": (data.p,), "rate_scale": (data.qd, data.pd)}
    scales = {}
    for name in PHASE_KINDS[kind].scales:
        if any(array is None for array in arrays[name]):
            raise InputError("the data have no momenta p and their rates pd; add them, or set p = qd per unit of mass")
        numbers = np.concatenate([np.ravel(array) for array in arrays[name] if array is not None])[:, None]
        size = float(spread("p" if name == "momentum_scale" else "qd or pd", numbers)[0])
        scales[name] = float(f"{size:.3g}") if size > 0 else 1.0
    return {"kind": kind, "needs": needs._asdict(), "precision": precision, **keywords, **scales}


def build_phase(description: dict[str, Any]) -> Model:
    """The model that a description stands for.

    Raises:
        InputError: an unknown kind, needs, activation or precision, or a missing or unknown key.
    """
    return build_by(description, PHASE_KINDS, _make)


def _make(kind: PhaseKind, needs: Needs, *, dtype: Any, friction_width: int = 0, **keywords: Any) -> Model:
    if kind.energy is None:
        assert kind.field is not None
        return kind.field(needs, dtype=dtype, **keywords)
    if needs.friction and friction_width:
        conservative = kind.energy(needs._replace(friction=False), dtype=dtype, **keywords)
        return make_dissipative(conservative, needs, width=friction_width, dtype=dtype)
    return kind.energy(needs, dtype=dtype, **keywords)
