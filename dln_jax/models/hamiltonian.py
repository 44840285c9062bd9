"""Hamiltonian models: three kinds of neural network, dissipation, pair interactions of bodies, and polynomials.

    structured:   H = ½ |L(q)ᵀ p|² + V(q),  M⁻¹ = L Lᵀ,  diag L = softplus(x + shift) + floor
    black-box:    H = network([features(q), p / momentum_scale])
    separable:    H = T(p / momentum_scale) + V(features(q)), with two networks
    dissipative:  D = ½ sum_j c_j(q) qd_j²,   c = softplus(network(features(q))) > 0,   dH/dt = -2 D <= 0
    pairwise:     H = sum_i |p_i|² / (2 m_i) + sum over pairs of U(r_ij),   U(r) = w·f(r) + network(f(r))
    polynomial:   H = sum_k c_k phi_k(q, p)

The black-box model comes from Greydanus, Dzamba and Yosinski 2019, "Hamiltonian Neural Networks". The structured model
follows Lutter and Peters 2021, with a network for the inverse mass matrix. The separable model follows Chen et al.
2020, "Symplectic recurrent neural networks". The separable model cannot express products of q and p, so explicit
symplectic steps (`mechanics.integrators.stormer_verlet`) apply to it. It suits systems with a kinetic energy of p
alone.

`mechanics.equations.flow` turns all of them into Hamilton's equations, and `dynamics` into equations in velocities.

In the pairwise model, q and p hold one body after the other, [bodies * dimension], or with `order="axes"` one axis
after the other (x1, x2, .., y1, y2, ..), as in many published files. H depends only on distances, so total momentum and
angular momentum are conserved for any parameters, and identical bodies are interchangeable.

The features f of r, in units of `distance_scale`, are r, 1/r and log r by default: the potentials of a constant force
and of the laws of Newton and Coulomb in space (1/r) and in the plane (log r). Their linear term w·f is exact for these
laws and does not saturate as bodies approach; the network learns the rest. Leave out the features of laws that you do
not want to assume. At r = 0 the energy (with 1/r or log r) and its derivative are not finite, because there is no
softening.

The functions phi_k of the polynomial model are all products up to a total degree. Their factors are powers of p_j,
powers of prismatic displacements, and cos(n q_j) and sin(n q_j), of degree n, for revolute joints. The constant has no
effect on a motion and is left out. Hamilton's equations are linear in c: linear least squares identifies c from states
and their rates (`learning.matching.match_linear`). The number of terms grows exponentially with the number of
coordinates.
"""

import itertools
import math
from collections.abc import Callable
from functools import partial

import haiku as hk
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from dln_jax.errors import require_network
from dln_jax.mechanics.equations import Canonical
from dln_jax.mechanics.hamiltonian import Guess, HamiltonianSystem
from dln_jax.mechanics.natural import NaturalHamiltonian
from dln_jax.models.model import (
    Model,
    Parameters,
    Scale,
    black_box_terms,
    joint_features,
    model_of,
    per_coordinate,
    perceptrons,
    structured_terms,
    viscous_dissipation,
)
from dln_jax.nn.activations import Activation, tanh
from dln_jax.types import InputError, Matrix, Needs, Scalar, Vector, require_positive


def make_structured_hamiltonian(
    needs: Needs,
    *,
    width: int = 64,
    depth: int = 2,
    activation: Activation | str = tanh,
    diagonal_shift: float = 0.0,
    diagonal_floor: float = 0.1,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """Returns the (init, energies) pair of a structured Hamiltonian network.

    Args:
        diagonal_shift: added to the pre-activation of L's diagonal; sets the initial diagonal.
        diagonal_floor: smallest diagonal element of L, in the square root of the unit of M⁻¹.
        needs, width, depth, activation, dtype: as described in `models.model`.
    """
    networks = perceptrons(width, depth, activation)
    terms = partial(structured_terms, needs, networks, "inverse_factor", diagonal_shift, diagonal_floor)
    return model_of(NaturalHamiltonian, terms, needs, dtype)


def make_black_box_hamiltonian(
    needs: Needs,
    *,
    width: int = 64,
    depth: int = 2,
    activation: Activation | str = tanh,
    momentum_scale: Scale = 1.0,
    iterations: int = 8,
    initial_guess: Guess | None = None,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """Returns the (init, energies) pair of a black-box Hamiltonian network.

    Hamilton's equations hold for any parameters and need no solve for the momentum. Functions of (q, qd) do need it,
    and with an untrained network it may have no solution. They also need an activation with curvature in p, because M⁻¹
    is the second derivative by p. Leaving out gravity saves nothing.

    Args:
        momentum_scale: typical size of p; the network's input is divided by it.
        iterations: Newton steps to p(q, qd), as in `mechanics.hamiltonian.conjugate`.
        initial_guess: (q, qd) -> initial p [d] of these steps; zero by default.
        needs, width, depth, activation, dtype: as described in `models.model`.
    """
    require_positive(iterations=iterations)
    momenta = per_coordinate(needs, "momentum_scale", momentum_scale)
    terms = partial(black_box_terms, needs, perceptrons(width, depth, activation), "hamiltonian", momenta)
    record = partial(HamiltonianSystem, iterations=iterations, initial_guess=initial_guess)
    return model_of(record, terms, needs, dtype)


def make_separable_hamiltonian(
    needs: Needs,
    *,
    width: int = 64,
    depth: int = 2,
    activation: Activation | str = tanh,
    momentum_scale: Scale = 1.0,
    iterations: int = 8,
    initial_guess: Guess | None = None,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """Returns the (init, energies) pair of T(p) + V(q), without V if there is no gravity.

    Arguments and requirements on the activation are as for `make_black_box_hamiltonian`; `initial_guess` returns p(qd).
    """
    require_positive(iterations=iterations)
    networks = perceptrons(width, depth, activation)
    momenta = per_coordinate(needs, "momentum_scale", momentum_scale)

    def kinetic(p: Vector) -> Scalar:
        return networks("kinetic", 1)(p / jnp.asarray(momenta, p.dtype))[0]

    def potential(q: Vector) -> Scalar:
        return networks("potential", 1)(joint_features(needs, q))[0]

    def energies(kinetic, potential=None, dissipation=None) -> HamiltonianSystem:
        def total(q: Vector, p: Vector) -> Scalar:
            return kinetic(p) if potential is None else kinetic(p) + potential(q)

        return HamiltonianSystem(total, dissipation, iterations, initial_guess)

    terms = {
        "kinetic": kinetic,
        "potential": potential if needs.gravity else None,
        "dissipation": viscous_dissipation if needs.friction else None,
    }
    return model_of(energies, lambda: terms, needs, dtype)


def make_dissipative(
    make: Callable[[Needs], Model],
    needs: Needs,
    *,
    friction_width: int = 0,
    friction_depth: int = 1,
    friction_activation: Activation | str = tanh,
    initial_friction: float = 0.05,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """Adds friction that may depend on q to a Hamiltonian `Model`, which then loses energy for any parameters.

    Args:
        make: needs -> the model.
        needs: needs of the scene; without friction the keywords have no effect.
        friction_width: hidden units of the network for c; 0 keeps the constant coefficients of `make`.
        initial_friction: approximate initial value of c, in N m s or N s/m.
        friction_depth, friction_activation, dtype: keywords of the network, as described in `models.model`.

    Raises:
        InputError: a width, depth or friction is not positive.
    """
    if not (needs.friction and friction_width):
        return make(needs)
    require_network(width=friction_width, depth=friction_depth)
    require_positive(initial_friction=initial_friction)
    networks = perceptrons(friction_width, friction_depth, friction_activation)
    model, d = make(needs._replace(friction=False)), needs.degrees_of_freedom
    shift = jnp.log(jnp.expm1(jnp.asarray(initial_friction, dtype)))

    @hk.without_apply_rng
    @hk.transform
    def coefficients(q: Vector) -> Vector:
        return jax.nn.softplus(networks("friction", d)(joint_features(needs, q)) + shift)

    def init(key: Array) -> Parameters:
        first, second = jax.random.split(key)
        return {"energy": model.init(first), "friction": coefficients.init(second, jnp.zeros(d, dtype))}

    def energies(parameters: Parameters) -> Canonical:
        def dissipation(q: Vector, qd: Vector) -> Scalar:
            return 0.5 * jnp.sum(coefficients.apply(parameters["friction"], q) * qd**2)

        return model.energies(parameters["energy"])._replace(dissipation=dissipation)

    return Model(init, energies)


FEATURES = {"distance": lambda r: r, "inverse": lambda r: 1 / r, "logarithm": jnp.log}
"""Functions of the distance that a pair energy may depend on."""


def make_pairwise_hamiltonian(
    needs: Needs,
    *,
    dimension: int = 2,
    order: str = "bodies",
    alike: bool = True,
    features: tuple[str, ...] = ("distance", "inverse", "logarithm"),
    distance_scale: float = 1.0,
    width: int = 32,
    depth: int = 2,
    activation: Activation | str = tanh,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """Returns the (init, energies) pair of bodies with learned masses and pair energies.

    Args:
        needs: prismatic coordinates of at least two bodies, without friction.
        dimension: coordinates per body.
        order: order of the coordinates, body by body (x1, y1, x2, y2) or axis by axis (x1, x2, y1, y2).
        alike: all bodies share one mass and all pairs one energy; otherwise each has its own.
        features: names from `FEATURES`.
        distance_scale: typical distance in m; distances are divided by it.
        width, depth, activation, dtype: as described in `models.model`.

    Raises:
        InputError: the needs do not fit, there are fewer than two bodies, a number is not positive, the order is
            unknown, or features are unknown, repeated or missing.
    """
    require_positive(dimension=dimension, distance_scale=distance_scale)
    networks = perceptrons(width, depth, activation)
    has_friction = needs.friction or needs.joint_friction
    if set(needs.joints) != {"prismatic"} or needs.degrees_of_freedom % dimension or has_friction:
        raise InputError(
            f"the pairwise model needs {dimension} prismatic coordinates per body and no friction; got {needs}"
        )
    if (bodies := needs.degrees_of_freedom // dimension) < 2:
        raise InputError(f"bodies is {bodies}; expected at least 2: the energy is a sum over pairs")
    if order not in ("bodies", "axes"):
        raise InputError(f"order is {order!r}; expected 'bodies' (x1, y1, x2, y2) or 'axes' (x1, x2, y1, y2)")
    if not features or len(set(features)) < len(features) or not set(features) <= set(FEATURES):
        raise InputError(f"features are {features}; expected some of {', '.join(FEATURES)}, each once")
    first, second = np.triu_indices(bodies, 1)
    # Each row subtracts the positions of two bodies.
    difference = np.eye(bodies)[first] - np.eye(bodies)[second]
    kinds = 1 if alike else len(difference)

    def pair_energies(r: Float[Array, " pairs"]) -> Float[Array, "pairs kinds"]:
        seen = jnp.stack([FEATURES[name](r / distance_scale) for name in features], axis=1)
        return hk.Linear(kinds, with_bias=False, name="pair_linear")(seen) + networks("pair", kinds)(seen)

    def potential(q: Vector) -> Scalar:
        positions = q.reshape(bodies, dimension) if order == "bodies" else q.reshape(dimension, bodies).T
        separation = jnp.matmul(jnp.asarray(difference, q.dtype), positions, precision="highest")
        energies = pair_energies(jnp.sqrt(jnp.sum(separation**2, axis=1)))
        return jnp.sum(energies) if alike else jnp.trace(energies)

    def inverse_factor(q: Vector) -> Matrix:
        logarithm = hk.get_parameter("log_mass", (1 if alike else bodies,), q.dtype, hk.initializers.Constant(0.0))
        factors = jnp.exp(-0.5 * jnp.broadcast_to(logarithm, (bodies,)))
        return jnp.diag(jnp.repeat(factors, dimension) if order == "bodies" else jnp.tile(factors, dimension))

    terms = {"potential": potential, "inverse_factor": inverse_factor}
    return model_of(NaturalHamiltonian, lambda: terms, needs, dtype)


MOST_TERMS = 5_000
"""Largest number of terms of the energy; the fit's cost grows with its square."""


def make_polynomial_hamiltonian(needs: Needs, *, degree: int = 2, dtype: DTypeLike = jnp.float32) -> Model:
    """Returns the (init, energies) pair; the parameters are the vector c, initially zero.

    Args:
        needs: needs of the scene. Friction is refused, because it would not be linear in c.
        degree: the largest total degree of a term.

    Raises:
        InputError: the scene has friction, the degree is below 2, or there are more than `MOST_TERMS` terms.
    """
    if needs.friction or needs.joint_friction:
        raise InputError("the polynomial Hamiltonian conserves energy; use a dissipative model for friction")
    if degree < 2:
        raise InputError(f"degree is {degree}; expected at least 2, since kinetic energy is quadratic in p")
    d = needs.degrees_of_freedom
    # Degrees of the functions of one variable, ordered as in their table: 1, then x^n, or cos nx and sin nx.
    powers = list(range(degree + 1))
    harmonics = [(place + 1) // 2 for place in range(2 * degree + 1)]
    choices = [harmonics if joint == "revolute" else powers for joint in needs.joints] + [powers] * d
    most = math.prod(map(len, choices))
    if most > MOST_TERMS * 100:
        raise InputError(f"{d} coordinates of degree {degree} give too many terms; lower the degree")
    terms = np.array(
        [
            [place for place, _ in term]
            for term in itertools.product(*map(enumerate, choices))
            if 0 < sum(order for _, order in term) <= degree
        ]
    )
    if len(terms) > MOST_TERMS:
        raise InputError(f"degree {degree} gives {len(terms)} terms; the limit is {MOST_TERMS}: lower the degree")

    def table(revolute: bool, x: Scalar) -> Float[Array, " functions"]:
        orders = range(1, degree + 1)
        values = [wave(n * x) for n in orders for wave in (jnp.cos, jnp.sin)] if revolute else [x**n for n in orders]
        return jnp.stack([jnp.ones_like(x), *values])

    def values(q: Vector, p: Vector) -> Float[Array, " terms"]:
        product = jnp.ones(len(terms), p.dtype)
        for j in range(d):
            product *= table(needs.joints[j] == "revolute", q[j])[terms[:, j]]
            product *= table(False, p[j])[terms[:, d + j]]
        return product

    def energies(parameters: Array) -> HamiltonianSystem:
        return HamiltonianSystem(lambda q, p: jnp.dot(parameters, values(q, p)))

    return Model(init=lambda key: jnp.zeros(len(terms), dtype), energies=energies)
