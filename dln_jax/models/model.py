"""The type of all models (parameters and energies), and deep Lagrangian networks.

    structured:  L = ½ qdᵀ M(q) qd - V(q),  M = L(q) L(q)ᵀ,  diag L = softplus(x + shift) + floor
    black-box:   L = network([features(q), qd / rate_scale])

The structured model (Lutter, Ritter and Peters 2019, "Deep Lagrangian Networks") has a network for the Cholesky factor
of the mass matrix and another for the potential. Only the terms of the scene are built: no potential network without
gravity, no dissipation without friction, no cos and sin for prismatic joints.

The black-box model (Lutter and Peters 2021, "Combining physics and deep learning to learn continuous-time dynamics
models", section on black-box models) has no structure. Its mass matrix d²L/dqd² is symmetric but may be indefinite:
`metrics.errors` reports where it is.

All factories take these keywords. Networks have `depth` hidden layers of `width` units. Their `activation` must be
smooth if forces are derivatives of an energy. `dtype` is the type of the parameters. `needs` describes the scene and
decides features and terms. Factories raise InputError if a width, depth or scale is not positive, or if a scale is
neither one number nor one per coordinate.
"""

import inspect
import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import haiku as hk
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from dln_jax.errors import require_network
from dln_jax.mechanics.arguments import require_shape
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.mechanics.natural import NaturalSystem
from dln_jax.nn.activations import Activation, tanh
from dln_jax.nn.activations import activation as activation_of
from dln_jax.types import InputError, Matrix, Needs, Scalar, Vector, require_positive

Parameters = Any
"""A pytree of arrays."""
Scale = float | tuple[float, ...]
"""Typical size of a quantity, in its unit: one number, or one per coordinate."""
Networks = Callable[[str, int], hk.nets.MLP]
"""(name, outputs) -> network, from `perceptrons`."""


class Model(NamedTuple):
    """Energies with parameters, as a pair of pure functions.

    `energies` closes over the parameters, so a trained model and a textbook system have the same type and run through
    the same mechanics: `dynamics(model.energies(parameters))`. Write your own with any network library; a Haiku
    transform fits as it is.

    Example:
        >>> import jax
        >>> import dln_jax
        >>> def energies(m):
        ...     return dln_jax.LagrangianSystem(lambda q, qd: 0.5 * m["mass"] * qd @ qd)
        >>> cart = dln_jax.Model(lambda key: {"mass": jax.random.uniform(key, (), minval=1.0, maxval=2.0)}, energies)
        >>> print(dln_jax.dynamics(cart.energies({"mass": 3.0})).inverse_dynamics([0.0], [0.0], [2.0]))
        [6.]
    """

    init: Callable[[Array], Parameters]
    """Random key -> parameters."""
    energies: Callable[[Parameters], Any]
    """Parameters -> a record of energies, one of `mechanics.equations.System`, as functions of one state."""

    def __repr__(self) -> str:
        """Number of parameters, and their shapes."""
        leaves = jax.tree_util.tree_leaves_with_path(jax.eval_shape(self.init, jax.random.key(0)))
        shapes = ", ".join(f"{jax.tree_util.keystr(path)} {list(leaf.shape)}" for path, leaf in leaves)
        count = sum(math.prod(leaf.shape) for _, leaf in leaves)
        return f"Model of {count:,} parameters\n  {shapes:.100}"


def make_delan(
    needs: Needs,
    *,
    width: int = 64,
    depth: int = 2,
    activation: Activation | str = tanh,
    diagonal_shift: float = 2.0,
    diagonal_floor: float = 0.1,
    shared_trunk: bool = False,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """Returns a deep Lagrangian network with structure (Lutter, Ritter and Peters 2019).

    L(q, qd) = ½ qdᵀ M(q) qd - V(q), with M = L Lᵀ. One network has the entries of the Cholesky factor L as outputs,
    another the potential V. Revolute joints enter as cos and sin.

    Args:
        needs: joints and terms of the system. The model has no potential without gravity, and no dissipation without
            friction.
        width: units of each hidden layer.
        depth: number of hidden layers.
        activation: name or function; it must be smooth, because forces are derivatives of the networks.
        diagonal_shift: added to the pre-activation of L's diagonal; sets the initial diagonal.
        diagonal_floor: smallest diagonal element of L, in the square root of the unit of M; keeps M regular.
        shared_trunk: use one network for factor and potential instead of two.
        dtype: type of the parameters.

    Raises:
        InputError: width or depth is not positive, or the activation is unknown.

    Example:
        >>> import jax
        >>> import dln_jax
        >>> model = dln_jax.make_delan(dln_jax.Needs(joints=("revolute", "revolute")), width=16)
        >>> arm = dln_jax.dynamics(model.energies(model.init(jax.random.key(0))))
        >>> print(arm.inverse_dynamics([0.3, 1.2], [0.5, -1.0], [2.0, 0.1]).shape)
        (2,)
    """
    networks = perceptrons(width, depth, activation)
    terms = partial(
        structured_terms, needs, networks, "cholesky", diagonal_shift, diagonal_floor, shared_trunk=shared_trunk
    )
    return model_of(NaturalSystem, terms, needs, dtype)


def make_black_box_lagrangian(
    needs: Needs,
    *,
    width: int = 64,
    depth: int = 2,
    activation: Activation | str = tanh,
    rate_scale: Scale = 1.0,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """Returns the (init, energies) pair of a black-box Lagrangian: one network, so leaving out gravity saves nothing.

    The activation needs curvature in qd, since M is the second derivative by qd.

    Args:
        rate_scale: typical size of qd; the network's input is divided by it.
        needs, width, depth, activation, dtype: as described in `models.model`.
    """
    rates = per_coordinate(needs, "rate_scale", rate_scale)
    terms = partial(black_box_terms, needs, perceptrons(width, depth, activation), "lagrangian", rates)
    return model_of(LagrangianSystem, terms, needs, dtype)


def model_of(
    record: Callable[..., Any], terms: Callable[[], Mapping[str, Callable[..., Any] | None]], needs: Needs, dtype: Any
) -> Model:
    """Returns a model with the energies `record(**terms)`.

    Args:
        record: takes functions of one state as keywords; absent terms are omitted.
        terms: builds Haiku modules and returns functions of them by name; `None` for absent terms.
        needs: needs of the scene. Parameters are initialised at q = (0, 1, ..), where no two bodies coincide.
    """
    d = needs.degrees_of_freedom

    def build():
        functions = {name: term for name, term in terms().items() if term is not None}

        def initialise(q: Array) -> None:
            for function in functions.values():
                function(*[q] * len(inspect.signature(function).parameters))

        return initialise, functions

    networks = hk.without_apply_rng(hk.multi_transform(build))

    def energies(parameters: Parameters) -> Any:
        def checked(function: Callable[..., Any], *state: Array) -> Any:
            for vector in state:
                if vector.shape != (d,):
                    require_shape("a state of this model", vector.shape, (d,))
            return function(parameters, *state)

        return record(**{name: partial(checked, function) for name, function in networks.apply.items()})

    return Model(lambda key: networks.init(key, jnp.asarray(np.arange(d), dtype)), energies)


def linearised(
    model: Model, parameters: Parameters, q: Vector, qd: Vector, qdd: Vector
) -> tuple[Float[Array, "d P"], Vector]:
    """Returns Phi = d tau / d theta of one state, with columns in the order of `ravel_pytree(parameters)`, and tau."""

    def torque(parameters: Parameters) -> Vector:
        return dynamics(model.energies(parameters)).inverse_dynamics(q, qd, qdd)

    # Reverse mode takes d pull-backs; forward mode would take a push-forward for all P parameters.
    tau, pull_back = jax.vjp(torque, parameters)
    (rows,) = jax.vmap(pull_back)(np.eye(tau.shape[0], dtype=tau.dtype))
    return jnp.concatenate([leaf.reshape(tau.shape[0], -1) for leaf in jax.tree.leaves(rows)], axis=1), tau


def perceptrons(width: int, depth: int, activation: Activation | str) -> Callable[[str, int], hk.nets.MLP]:
    """Checks a model's keywords and returns (name, outputs) -> network, for use inside a transformed function.

    Networks have `depth` hidden layers of `width` units and a linear output.
    """
    require_network(width=width, depth=depth)
    function = activation_of(activation).value
    return lambda name, outputs: hk.nets.MLP([width] * depth + [outputs], activation=function, name=name)


def joint_features(needs: Needs, q: Vector) -> Float[Array, " features"]:
    """Returns cos and sin of revolute joints, which are periodic, and prismatic displacements unchanged.

    Only the kinds of joints in the scene add operations.
    """
    revolute = np.array([joint == "revolute" for joint in needs.joints])
    angles = q[np.flatnonzero(revolute)]
    features = [jnp.cos(angles), jnp.sin(angles)] if revolute.any() else []
    if not revolute.all():
        features.append(unsaturated(q[np.flatnonzero(~revolute)]))
    return jnp.concatenate(features)


def inputs_of(needs: Needs, q: Vector, *scaled: tuple[Vector, tuple[float, ...]]) -> Float[Array, " inputs"]:
    """Returns a network's inputs: features of q, and vectors x divided by their sizes, as pairs (x, sizes)."""
    return jnp.concatenate([joint_features(needs, q), *(x / jnp.asarray(sizes, x.dtype) for x, sizes in scaled)])


def unsaturated(x: Float[Array, " inputs"]) -> Float[Array, " inputs"]:
    """Returns x with NaN in place of infinities: a saturated network would return a plausible number for them."""
    return x + 0 * x


def viscous_dissipation(q: Vector, qd: Vector) -> Scalar:
    """D = ½ Σ b qd², with one learned coefficient b = softplus(x) > 0 per coordinate; inside a transformed function."""
    coefficients = hk.get_parameter("viscous_friction", qd.shape, qd.dtype, hk.initializers.Constant(-3.0))
    return 0.5 * jnp.sum(jax.nn.softplus(coefficients) * qd**2)


def per_coordinate(needs: Needs, name: str, scale: Scale) -> tuple[float, ...]:
    """Returns one positive size per coordinate; raises InputError otherwise."""
    d = needs.degrees_of_freedom
    sizes = scale if isinstance(scale, tuple) else (scale,) * d
    if len(sizes) != d:
        raise InputError(f"{name} has {len(sizes)} sizes; expected one number, or one for each of {d} coordinates")
    for size in sizes:
        require_positive(**{name: size})
    return sizes


def cholesky_factor(entries: Float[Array, "entries"], d: int, *, shift: float, floor: float) -> Matrix:
    """Returns lower triangular L [d, d]: diagonal softplus(entries[:d] + shift) + floor, the other entries below."""
    diagonal = jax.nn.softplus(entries[:d] + shift) + floor
    return jnp.diag(diagonal).at[np.tril_indices(d, -1)].set(entries[d:])


def structured_terms(
    needs: Needs, networks: Networks, factor: str, shift: float, floor: float, *, shared_trunk: bool = False
) -> dict[str, Callable[..., Any] | None]:
    """Returns L(q) under the name `factor`, and the potential and dissipation."""
    d = len(needs.joints)
    entries = d * (d + 1) // 2
    shared = shared_trunk and needs.gravity
    first = networks("energies", entries + 1) if shared else networks("cholesky", entries)
    second = first if shared else networks("potential", 1)

    def cholesky(q: Vector) -> Matrix:
        return cholesky_factor(first(joint_features(needs, q))[:entries], d, shift=shift, floor=floor)

    def potential(q: Vector) -> Scalar:
        return second(joint_features(needs, q))[-1]

    return {
        factor: cholesky,
        "potential": potential if needs.gravity else None,
        "dissipation": viscous_dissipation if needs.friction else None,
    }


def black_box_terms(
    needs: Needs, networks: Networks, name: str, sizes: tuple[float, ...]
) -> dict[str, Callable[[Vector, Vector], Scalar] | None]:
    """Returns the energy network([features(q), x / sizes]) -> scalar under `name`, and the dissipation."""

    def energy(q: Vector, x: Vector) -> Scalar:
        return networks(name, 1)(inputs_of(needs, q, (x, sizes)))[0]

    return {name: energy, "dissipation": viscous_dissipation if needs.friction else None}
