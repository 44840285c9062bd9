"""Models of a phase space: what gives the rates (qd, pd) of a state (q, p), with an energy or without.

    Hamiltonian:   qd = dH/dp,   pd = -dH/dq - dD/dqd(q, qd)
    dissipative:   D = ½ sum_j c_j(q) qd_j²,   c = softplus(network(features(q))) > 0,   dH/dt = -2 D <= 0
    baseline:      (qd, pd) = rate_scale network([features(q), p / momentum_scale])

No force is applied. D is absent where a scene conserves its energy. The baseline knows no physics (as the one that
Greydanus, Dzamba and Yosinski 2019 compare with).
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import haiku as hk
import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike

from dln_jax.mechanics import hamiltonian
from dln_jax.mechanics.arguments import vectors
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.models.black_box import Scale, per_coordinate
from dln_jax.models.features import joint_features, unsaturated
from dln_jax.models.model import Model, Parameters
from dln_jax.nn.activations import Activation, tanh
from dln_jax.types import Dissipation, Hamiltonian, Needs, Scalar, Vector, VectorLike, require_positive


class PhaseField(NamedTuple):
    """A system without applied forces; functions of one state, which `vmap` takes over samples.

    `make_phase_field` makes one, whose functions convert or refuse their arguments as those of `Dynamics` do.
    """

    rates: Callable[[VectorLike, VectorLike], tuple[Array, Array]]
    """(q, p) -> (qd, pd), each [d]."""
    energy: Callable[[VectorLike, VectorLike], Array] | None = None
    """(q, p) -> H, scalar; `None` for a model that has no energy."""
    dissipation: Callable[[VectorLike, VectorLike], Array] | None = None
    """(q, qd) -> Rayleigh function D >= 0; `None` where nothing is lost, or where it is not known apart."""


class PhaseModel(NamedTuple):
    """A phase field with parameters, as an (init, apply) pair: what `Model` is to `Dynamics`."""

    init: Callable[[Array], Parameters]
    """Random key -> parameters."""
    apply: Callable[[Parameters], PhaseField]
    """Parameters -> phase field."""


def make_phase_field(
    rates: Callable[..., tuple[Array, Array]],
    energy: Hamiltonian | None = None,
    dissipation: Dissipation | None = None,
    *,
    degrees_of_freedom: int | None = None,
) -> PhaseField:
    """A phase field from functions of vectors [d] of one type; d as in `mechanics.dynamics.make_dynamics`."""
    d = degrees_of_freedom
    return PhaseField(
        rates=lambda q, p: rates(*vectors(d, q=q, p=p)),
        energy=energy and (lambda q, p: energy(*vectors(d, q=q, p=p))),
        dissipation=dissipation and (lambda q, qd: dissipation(*vectors(d, q=q, qd=qd))),
    )


def phase_field(
    H: Hamiltonian, *, dissipation: Dissipation | None = None, degrees_of_freedom: int | None = None
) -> PhaseField:
    """Hamilton's equations of an energy, with the friction of a Rayleigh function where there is one."""

    def rates(q: Vector, p: Vector) -> tuple[Vector, Vector]:
        return hamiltonian.time_derivative(H, q, p, jnp.zeros_like(q), dissipation=dissipation)

    return make_phase_field(rates, H, dissipation, degrees_of_freedom=degrees_of_freedom)


def from_dynamics(dynamics: Dynamics) -> PhaseField:
    """The phase field of dynamics that have a Hamiltonian."""
    H, friction = dynamics.hamiltonian, dynamics.friction
    assert H is not None, "the dynamics have no Hamiltonian"
    # H and the friction refuse what is no state of theirs.
    conservative = phase_field(H)
    if friction is None:
        return conservative

    def rates(q: Vector, p: Vector) -> tuple[Vector, Vector]:
        qd, pd = conservative.rates(q, p)
        return qd, pd - friction(q, qd)

    return make_phase_field(rates, H)


def hamiltonian_phase_model(model: Model) -> PhaseModel:
    """Any Hamiltonian `Model` as a model of its phase space."""
    return PhaseModel(model.init, lambda parameters: from_dynamics(model.apply(parameters)))


def make_dissipative(
    model: Model,
    needs: Needs,
    *,
    width: int = 8,
    depth: int = 1,
    activation: Activation = tanh,
    initial_friction: float = 0.05,
    dtype: DTypeLike = jnp.float32,
) -> PhaseModel:
    """A Hamiltonian `Model` that loses energy by a friction that depends on q, for any parameters.

    Args:
        model: conserves its energy: made for needs without friction.
        needs: what the scene needs; without friction nothing is added.
        width: hidden units per layer of the network for c.
        depth: hidden layers of it.
        activation: of the hidden layers; it must be smooth.
        initial_friction: c to start from, about, in N m s or N s/m.
        dtype: of the parameters.

    Raises:
        InputError: a width, depth or friction that is not positive.
    """
    require_positive(width=width, depth=depth, initial_friction=initial_friction)
    if not needs.friction:
        return hamiltonian_phase_model(model)
    d = needs.degrees_of_freedom
    shift = jnp.log(jnp.expm1(jnp.asarray(initial_friction, dtype)))

    @hk.without_apply_rng
    @hk.transform
    def coefficients(q: Vector) -> Vector:
        layers = hk.nets.MLP([width] * depth + [d], activation=activation.value, name="friction")
        return jax.nn.softplus(layers(joint_features(needs, q)) + shift)

    def init(key: Array) -> Parameters:
        first, second = jax.random.split(key)
        return {"energy": model.init(first), "friction": coefficients.init(second, jnp.zeros(d, dtype))}

    def apply(parameters: Parameters) -> PhaseField:
        def dissipation(q: Vector, qd: Vector) -> Scalar:
            return 0.5 * jnp.sum(coefficients.apply(parameters["friction"], q) * qd**2)

        H = model.apply(parameters["energy"]).hamiltonian
        assert H is not None, "the model has no Hamiltonian"
        return phase_field(H, dissipation=dissipation, degrees_of_freedom=d)

    return PhaseModel(init, apply)


def make_phase_network(
    needs: Needs,
    *,
    width: int = 64,
    depth: int = 2,
    activation: Activation = tanh,
    momentum_scale: Scale = 1.0,
    rate_scale: Scale = 1.0,
    dtype: DTypeLike = jnp.float32,
) -> PhaseModel:
    """The (init, apply) pair of the baseline.

    Args:
        needs: what the scene needs; decides features. Forces are not told apart.
        width: hidden units per layer.
        depth: hidden layers.
        activation: of the hidden layers.
        momentum_scale: typical size of p.
        rate_scale: typical size of qd and pd.
        dtype: of the parameters.

    Raises:
        InputError: a width, depth or scale that is not positive, or scales that are not one per coordinate.
    """
    require_positive(width=width, depth=depth)
    momenta = per_coordinate(needs, "momentum_scale", momentum_scale)
    rates = per_coordinate(needs, "rate_scale", rate_scale)
    d = needs.degrees_of_freedom

    @hk.without_apply_rng
    @hk.transform
    def network(q: Vector, p: Vector):
        inputs = jnp.concatenate([joint_features(needs, q), unsaturated(p / jnp.asarray(momenta, p.dtype))])
        layers = hk.nets.MLP([width] * depth + [2 * d], activation=activation.value, name="rates")
        outputs = layers(inputs) * jnp.asarray(rates * 2, p.dtype)
        return outputs[:d], outputs[d:]

    start = jnp.zeros(d, dtype)
    return PhaseModel(
        init=lambda key: network.init(key, start, start),
        apply=lambda parameters: make_phase_field(functools.partial(network.apply, parameters), degrees_of_freedom=d),
    )
