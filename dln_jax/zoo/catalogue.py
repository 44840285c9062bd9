"""Catalogue of models by name: the factory, the scales taken from data, and the properties by construction.

A name is the same on command lines, in files, in tables and beside published numbers. Behaviour depends on
`Properties`, never on the spelling of a name.
"""

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax.typing import DTypeLike

from dln_jax.mechanics.trees.description import tree_from_json
from dln_jax.models.baselines import (
    make_differential_network,
    make_feed_forward,
    make_helmholtz,
    make_phase_network,
)
from dln_jax.models.hamiltonian import (
    make_black_box_hamiltonian,
    make_dissipative,
    make_pairwise_hamiltonian,
    make_polynomial_hamiltonian,
    make_separable_hamiltonian,
    make_structured_hamiltonian,
)
from dln_jax.models.joint_friction import with_joint_friction
from dln_jax.models.kernel import make_trigonometric_kernel
from dln_jax.models.latent_phase import make_image_model
from dln_jax.models.model import Model, make_black_box_lagrangian, make_delan
from dln_jax.models.residual import make_residual, make_with_residual
from dln_jax.models.trees import make_rigid_tree, make_serial_tree
from dln_jax.models.trigonometric import make_planar_chain, make_trigonometric
from dln_jax.types import InputError, Needs


class Properties(NamedTuple):
    """Properties of a model that hold for any parameters."""

    energy: bool = True
    """Its functions derive from an energy, so it has a mass matrix."""
    definite: bool = False
    """Its mass matrix is positive definite by construction."""
    canonical: bool = False
    """It is a function of (q, p), fitted by Hamilton's equations to data with momenta."""
    linear: bool = False
    """Its parameters enter linearly, so one least-squares problem fits them."""
    searched: bool = False
    """A dedicated search finds its parameters (`learning.kinematics`)."""
    kernel: bool = False
    """It is built from training samples, with one equation per torque (`learning.kernel`)."""


class Entry(NamedTuple):
    """A model of the catalogue."""

    factory: Callable[..., Any]
    """Makes the model from keywords, including `needs` and `dtype` if it takes them."""
    properties: Properties
    sizes: Mapping[str, tuple[str, ...]] = {}
    """Keywords for typical sizes -> the arrays of `Trajectories` that set them by their standard deviation."""
    additions: tuple[Callable[..., Model], ...] = ()
    """Functions that add terms to the factory's model; the last one is applied first. Each takes `make`, which makes
    the model for other needs, then `needs`, then its own keywords."""


def assembled(functions: tuple[Callable[..., Any], ...], keywords: Mapping[str, Any]) -> Any:
    """Calls the factory (the last function) and wraps the additions around it, each with its own keywords."""
    first, *rest = functions
    own = {key: keywords[key] for key in inspect.signature(first).parameters if key in keywords}
    if not rest:
        return first(**own)
    return first(lambda needs: assembled(tuple(rest), {**keywords, "needs": needs}), **own)


def friction_laws(*, linear: bool) -> Callable[..., Model]:
    """Returns the addition that gives a model the friction laws in its needs; `linear` as in `Properties`."""

    def add(make: Callable[[Needs], Model], needs: Needs, *, dtype: DTypeLike = jnp.float32) -> Model:
        return with_joint_friction(make(needs._replace(joint_friction=())), needs, linear=linear, dtype=dtype)

    return add


@functools.wraps(make_residual)
def residual_network(make: Callable[[Needs], Model], needs: Needs, **keywords: Any) -> Model:
    """Adds the residual of `make_residual` and takes its keywords."""
    return make_with_residual(make(needs), make_residual(needs, **keywords))


def make_stored_tree(needs: Needs, *, tree: dict[str, Any], **keywords: Any) -> Model:
    """Calls `make_rigid_tree` with a tree from `tree_to_json` and the friction laws of the needs."""
    frames = tree_from_json(tree)
    if (frames.joints, frames.needs.gravity) != (needs.joints, needs.gravity):
        raise InputError(
            f"the rigid tree has joints {frames.joints} and gravity={frames.needs.gravity}, but the needs are {needs}; "
            "pass needs that match"
        )
    return make_rigid_tree(frames, friction=needs.joint_friction or needs.friction, **keywords)


# Descriptions list every keyword, so the signature includes the keywords of `make_rigid_tree`.
_own, _rigid = (inspect.signature(function).parameters for function in (make_stored_tree, make_rigid_tree))
_shared = [parameter for name, parameter in _rigid.items() if name not in ("tree", "friction")]
make_stored_tree.__signature__ = inspect.Signature([_own["needs"], _own["tree"], *_shared])  # type: ignore

MOMENTUM = {"momentum_scale": ("p",)}
LAWS, LINEAR = (friction_laws(linear=False),), (friction_laws(linear=True),)
NETWORK = (*LAWS, make_dissipative)
RATES = {"rate_scale": ("qd",), "acceleration_scale": ("qdd",), "tau_scale": ("tau",)}
CATALOGUE = {
    "structured-delan": Entry(make_delan, Properties(definite=True), additions=LAWS),
    "black-box-delan": Entry(make_black_box_lagrangian, Properties(), {"rate_scale": ("qd",)}, LAWS),
    "trigonometric": Entry(make_trigonometric, Properties(linear=True), additions=LINEAR),
    "trigonometric-residual": Entry(make_trigonometric, Properties(), additions=(residual_network, *LINEAR)),
    "trigonometric-kernel": Entry(make_trigonometric_kernel, Properties(kernel=True), additions=LINEAR),
    "trigonometric-kernel-residual": Entry(
        make_trigonometric_kernel, Properties(kernel=True), additions=(residual_network, *LINEAR)
    ),
    "planar-chain": Entry(make_planar_chain, Properties(linear=True), additions=LINEAR),
    "rigid-tree": Entry(make_stored_tree, Properties(linear=True)),
    "rigid-tree-residual": Entry(make_stored_tree, Properties(), additions=(residual_network,)),
    "learned-tree": Entry(make_serial_tree, Properties(searched=True)),
    "feed-forward": Entry(make_feed_forward, Properties(energy=False), RATES, LAWS),
    "structured-hnn": Entry(make_structured_hamiltonian, Properties(definite=True, canonical=True), additions=NETWORK),
    "black-box-hnn": Entry(make_black_box_hamiltonian, Properties(canonical=True), MOMENTUM, NETWORK),
    "separable-hnn": Entry(make_separable_hamiltonian, Properties(canonical=True), MOMENTUM, NETWORK),
    "pairwise-hnn": Entry(make_pairwise_hamiltonian, Properties(definite=True, canonical=True)),
    "polynomial-hamiltonian": Entry(make_polynomial_hamiltonian, Properties(canonical=True, linear=True)),
    "phase-network": Entry(
        make_phase_network,
        Properties(energy=False, canonical=True),
        {**MOMENTUM, "rate_scale": ("qd", "pd")},
        LAWS,
    ),
    "helmholtz-hnn": Entry(make_helmholtz, Properties(energy=False, canonical=True), MOMENTUM, LAWS),
    "differential-network": Entry(make_differential_network, Properties(energy=False)),
    "latent-phase": Entry(make_image_model, Properties(energy=False)),
}
"""Every model that a command can train or a file can name."""


def entry_of(name: str) -> Entry:
    """Returns the catalogue entry with this name.

    Raises:
        InputError: an unknown name.
    """
    if name not in CATALOGUE:
        raise InputError(f"model is {name!r:.60}; this release knows {', '.join(CATALOGUE)}")
    return CATALOGUE[name]
