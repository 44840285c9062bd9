"""Catalogue of models by name: the factory, the scales taken from data, and the properties by construction.

A name is the same on command lines, in files, in tables and beside published numbers. Behaviour depends on
`Properties`, never on the spelling of a name.
"""

import inspect
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax.typing import DTypeLike

from dln_jax.mechanics.trees import tree_from_json
from dln_jax.models.baselines import make_feed_forward, make_helmholtz, make_phase_network
from dln_jax.models.hamiltonian import (
    make_black_box_hamiltonian,
    make_dissipative,
    make_separable_hamiltonian,
    make_structured_hamiltonian,
)
from dln_jax.models.joint_friction import with_joint_friction
from dln_jax.models.lagrangian import make_black_box_lagrangian, make_delan
from dln_jax.models.model import Model, Scale
from dln_jax.models.n_body import make_pairwise_hamiltonian
from dln_jax.models.planar_chain import make_planar_chain
from dln_jax.models.polynomial_hamiltonian import make_polynomial_hamiltonian
from dln_jax.models.residual import make_residual, make_with_residual
from dln_jax.models.rigid_tree import make_rigid_tree
from dln_jax.models.serial_tree import make_serial_tree
from dln_jax.models.trigonometric import make_trigonometric
from dln_jax.models.trigonometric_kernel import make_trigonometric_kernel
from dln_jax.nn.activations import Activation, tanh
from dln_jax.sizes import require_network
from dln_jax.types import InputError, Needs, ResidualTerm, require_positive
from dln_jax.zoo.differential_network import make_differential_network
from dln_jax.zoo.images import make_image_model


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
    sizes: Mapping[str, tuple[str, ...]] = MappingProxyType({})
    """Keywords that are typical sizes, and the arrays of `Trajectories` whose standard deviation sets each."""


def extending(make: Callable[..., Model], *replaced: str) -> Callable[[Callable[..., Model]], Callable[..., Model]]:
    """Gives a factory that passes its `**keywords` on to `make` the signature of both, without the replaced ones.

    A description stores every keyword in the signature of its factory.
    """

    def decorate(factory: Callable[..., Model]) -> Callable[..., Model]:
        ours, theirs = (inspect.signature(each).parameters.values() for each in (factory, make))
        own = [each for each in ours if each.kind is not each.VAR_KEYWORD]
        names = {*replaced, *(each.name for each in own)}
        every = [*own, *(each for each in theirs if each.name not in names)]
        setattr(factory, "__signature__", inspect.Signature(every))  # noqa: B010
        return factory

    return decorate


def with_friction_network(make: Callable[..., Model]) -> Callable[..., Model]:
    """Adds friction that may depend on q to a Hamiltonian's factory: a network with `friction_width` hidden units.

    With `friction_width` 0 each coordinate has one coefficient, as in `make`. Without friction in the needs, the
    friction keywords have no effect.
    """

    @extending(make)
    def factory(
        needs: Needs,
        *,
        friction_width: int = 0,
        friction_depth: int = 1,
        friction_activation: Activation = tanh,
        initial_friction: float = 0.05,
        dtype: DTypeLike = jnp.float32,
        **keywords: Any,
    ) -> Model:
        if not (needs.friction and friction_width):
            return make(needs, dtype=dtype, **keywords)
        require_network(width=friction_width, depth=friction_depth)
        conservative = make(needs._replace(friction=False), dtype=dtype, **keywords)
        return make_dissipative(
            conservative,
            needs,
            width=friction_width,
            depth=friction_depth,
            activation=friction_activation,
            initial_friction=initial_friction,
            dtype=dtype,
        )

    return factory


def with_friction_laws(make: Callable[..., Model], *, linear: bool = False) -> Callable[..., Model]:
    """Adds the friction laws named by the needs to a factory; `linear` as for `with_joint_friction`."""

    @extending(make, "needs")
    def factory(needs: Needs, **keywords: Any) -> Model:
        model = make(needs._replace(joint_friction=()), **keywords)
        dtype = keywords.get("dtype", inspect.signature(make).parameters["dtype"].default)
        return with_joint_friction(model, needs, linear=linear, dtype=dtype)

    return factory


@extending(make_pairwise_hamiltonian, "bodies")
def make_pairwise(needs: Needs, *, dimension: int = 2, **keywords: Any) -> Model:
    """`make_pairwise_hamiltonian` for the bodies whose coordinates the needs state."""
    require_positive(dimension=dimension)
    has_friction = needs.friction or needs.joint_friction
    if set(needs.joints) != {"prismatic"} or needs.degrees_of_freedom % dimension or has_friction:
        raise InputError(
            f"the pairwise model takes positions of bodies, {dimension} for each, without friction; it got {needs}"
        )
    return make_pairwise_hamiltonian(needs.degrees_of_freedom // dimension, dimension, **keywords)


@extending(make_rigid_tree, "friction")
def make_stored_tree(needs: Needs, *, tree: dict[str, Any], **keywords: Any) -> Model:
    """`make_rigid_tree` for a tree from `mechanics.trees.tree_to_json`, with the friction named by the needs."""
    frames = tree_from_json(tree)
    if (frames.joints, frames.needs.gravity) != (needs.joints, needs.gravity):
        raise InputError(
            f"the rigid tree has the joints {frames.joints}, and gravity if it is not zero; it got {needs}"
        )
    return make_rigid_tree(frames, friction=needs.joint_friction or needs.friction, **keywords)


def with_residual_network(make: Callable[..., Model]) -> Callable[..., Model]:
    """Adds a `make_residual` to the factory of a model; its `velocity_scale` is called `resolved_velocity` here."""

    @extending(make)
    def factory(
        needs: Needs,
        *,
        terms: tuple[ResidualTerm, ...] = ("potential", "dissipation"),
        width: int = 8,
        depth: int = 1,
        activation: Activation = tanh,
        resolved_velocity: Scale = 0.05,
        torque_scale: Scale = 1.0,
        rate_scale: Scale = 1.0,
        acceleration_scale: Scale = 1.0,
        dtype: DTypeLike = jnp.float64,
        **keywords: Any,
    ) -> Model:
        residual = make_residual(
            needs,
            terms=tuple(terms),
            width=width,
            depth=depth,
            activation=activation,
            velocity_scale=resolved_velocity,
            torque_scale=torque_scale,
            rate_scale=rate_scale,
            acceleration_scale=acceleration_scale,
            dtype=dtype,
        )
        return make_with_residual(make(needs, dtype=dtype, **keywords), residual)

    return factory


MOMENTUM = {"momentum_scale": ("p",)}
make_basis = with_friction_laws(make_trigonometric, linear=True)
make_kernel = with_friction_laws(make_trigonometric_kernel, linear=True)
CATALOGUE = {
    "structured-delan": Entry(with_friction_laws(make_delan), Properties(definite=True)),
    "black-box-delan": Entry(with_friction_laws(make_black_box_lagrangian), Properties(), {"rate_scale": ("qd",)}),
    "trigonometric": Entry(make_basis, Properties(linear=True)),
    "trigonometric-residual": Entry(with_residual_network(make_basis), Properties()),
    "trigonometric-kernel": Entry(make_kernel, Properties(kernel=True)),
    "trigonometric-kernel-residual": Entry(with_residual_network(make_kernel), Properties(kernel=True)),
    "planar-chain": Entry(with_friction_laws(make_planar_chain, linear=True), Properties(linear=True)),
    "rigid-tree": Entry(make_stored_tree, Properties(linear=True)),
    "rigid-tree-residual": Entry(with_residual_network(make_stored_tree), Properties()),
    "learned-tree": Entry(make_serial_tree, Properties(searched=True)),
    "feed-forward": Entry(
        with_friction_laws(make_feed_forward),
        Properties(energy=False),
        {"rate_scale": ("qd",), "acceleration_scale": ("qdd",), "tau_scale": ("tau",)},
    ),
    "structured-hnn": Entry(
        with_friction_laws(with_friction_network(make_structured_hamiltonian)),
        Properties(definite=True, canonical=True),
    ),
    "black-box-hnn": Entry(
        with_friction_laws(with_friction_network(make_black_box_hamiltonian)), Properties(canonical=True), MOMENTUM
    ),
    "separable-hnn": Entry(
        with_friction_laws(with_friction_network(make_separable_hamiltonian)), Properties(canonical=True), MOMENTUM
    ),
    "pairwise-hnn": Entry(make_pairwise, Properties(definite=True, canonical=True)),
    "polynomial-hamiltonian": Entry(make_polynomial_hamiltonian, Properties(canonical=True, linear=True)),
    "phase-network": Entry(
        with_friction_laws(make_phase_network),
        Properties(energy=False, canonical=True),
        {**MOMENTUM, "rate_scale": ("qd", "pd")},
    ),
    "helmholtz-hnn": Entry(with_friction_laws(make_helmholtz), Properties(energy=False, canonical=True), MOMENTUM),
    "differential-network": Entry(make_differential_network, Properties(energy=False)),
    "latent-phase": Entry(make_image_model, Properties(energy=False)),
}
"""Every model that a command trains or a file names."""


def entry_of(name: str) -> Entry:
    """The catalogue entry with this name.

    Raises:
        InputError: an unknown name.
    """
    if name not in CATALOGUE:
        raise InputError(f"model is {name!r:.60}; this release knows {', '.join(CATALOGUE)}")
    return CATALOGUE[name]
