"""Bodies that interact in pairs, with an energy that depends on their distance.

    H = sum_i |p_i|² / (2 m_i) + sum over pairs of U(r_ij),    U(r) = w·f(r / scale) + network(f(r / scale))

q and p hold one body after the other, [bodies * dimension], or with `order="axes"` one axis after the other (x1, x2,
.., y1, y2, ..), as in many published files. H depends only on distances: it is invariant under translation, rotation
and reflection, so total momentum and angular momentum are conserved for any parameters. It is also invariant under
exchange of identical bodies.

The features f are r, 1/r and log r by default: the potentials of a constant force and of Newton's and Coulomb's law, in
space and in the plane. Their linear term w·f is exact for these laws and does not saturate as bodies approach, unlike a
bounded activation; the network learns the rest. To assume none of these laws, leave their features out.

At r = 0 the energy (with 1/r or log r) and its derivative are not finite: there is no softening.
"""

import haiku as hk
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from dln_jax.mechanics.natural import NaturalHamiltonian
from dln_jax.models.model import Model, model_of, perceptrons
from dln_jax.nn.activations import Activation, tanh
from dln_jax.types import InputError, Matrix, Needs, Scalar, Vector, require_positive

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
        alike: whether all bodies share one mass and all pairs one energy; otherwise they have their own.
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
            f"the pairwise model takes positions of bodies, {dimension} for each, without friction; it got {needs}"
        )
    if (bodies := needs.degrees_of_freedom // dimension) < 2:
        raise InputError(f"bodies is {bodies}; expected at least 2, since the energy is one of pairs")
    if order not in ("bodies", "axes"):
        raise InputError(f"order is {order!r}; expected 'bodies' (x1, y1, x2, y2) or 'axes' (x1, x2, y1, y2)")
    if not features or len(set(features)) < len(features) or not set(features) <= set(FEATURES):
        raise InputError(f"features are {features}; expected some of {', '.join(FEATURES)}, each once")
    first, second = np.triu_indices(bodies, 1)
    # Rows subtract one body's position from another's.
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
    return model_of(NaturalHamiltonian, lambda: terms, needs.degrees_of_freedom, dtype)
