"""The barrier that keeps bodies apart (Li et al. 2020, Incremental Potential Contact, section 4; Li et al. 2023).

    E = kappa A m(c) b(D) / h³,    b(D) = -(D - h²)² ln(D / h²) for 0 < D < h², else 0

with the squared distance D of the pair, the range h of the barrier, the area A of the pair and the stiffness kappa in
Pa. b is twice continuously differentiable at D = h² and grows without bound as D approaches zero, so bodies never
touch. Nearly parallel edges are mollified, because the closest points of two edges jump there:

    m(c) = (2 - c/epsilon) c/epsilon for c < epsilon, else 1,    c = |u x v|²,    epsilon = 1e-3 |U|² |V|²

for edges u, v, with U, V in the rest shape. Explicit formulas for the derivatives compile several times faster.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dln_jax.softbody.contact.distances import Stencil, closest, summed
from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.terms.contact import Slip, friction_energy
from dln_jax.softbody.terms.term import NOT_NEGATIVE, POSITIVE, Context, Numbers, Pose, material
from dln_jax.solvers.elements.moving import Elements, MovingEnergy

MOLLIFIED = 1e-3
"""Contact of edges is mollified below this squared sine of the angle between them (Li et al. 2020, section 5)."""


class ContactParameters(NamedTuple):
    """Parameters of a barrier contact."""

    distance: Float[Array, ""]
    """h in m; surfaces repel each other when closer."""
    stiffness: Float[Array, ""]
    """kappa in Pa."""
    friction: Float[Array, ""] | None
    """Coulomb's coefficient, or `None`."""
    shape: Any = None
    """The obstacle; `None` between bodies."""

    @property
    def pose(self) -> Pose | None:
        """Pose of the obstacle; `None` without friction."""
        return None if self.friction is None or self.shape is None else self.shape.pose


class Contact(NamedTuple):
    """A contact of a scene."""

    name: str
    """Key of its parameters in `Params.terms`; unique in a scene."""
    parameters: Any
    """Default parameters: a NamedTuple of arrays."""
    energies: tuple[MovingEnergy, ...]
    """The barrier and, with a coefficient of friction, the friction."""
    prepare: Callable[[Any, Context], tuple[Any, ...]]
    """(parameters, context) -> data of the energies in a step."""
    least_distance: Callable[[Float[Array, "n dim"], Elements, Any], Float[Array, ""]]
    """(positions, elements and data of the barrier) -> smallest distance in m, capped at h."""
    mesh: Mesh | None = None
    """As in `Term`."""
    changing: bool = True
    """True if the set of elements changes during a motion."""

    @property
    def friction(self) -> tuple[MovingEnergy, ...]:
        """The friction energy, if the contact has one."""
        return self.energies[1:]


class Pair(NamedTuple):
    """Contact data of one pair, or [pairs, ...] of all of them."""

    stencil: Stencil
    strength: Float[Array, "*pairs"]
    """kappa A / h³ in N/m³; zero for an unused slot of the list."""
    near: Float[Array, "*pairs"]
    """h² in m²."""
    parallel: Float[Array, "*pairs"]
    """epsilon in m⁴ of two edges; zero for other pairs, without mollifier."""


def contact_parameters(
    distance: float, stiffness: Numbers, friction: Numbers | None, shape: Any = None
) -> ContactParameters:
    """Returns validated parameters."""
    return ContactParameters(
        jnp.asarray(distance, dtype=float),
        material("the stiffness of a contact", stiffness, 1, "contact", POSITIVE),
        None if friction is None else material("friction", friction, 1, "contact", NOT_NEGATIVE),
        shape,
    )


def barrier(D: Float[Array, "*pairs"], near: Float[Array, "*pairs"]) -> tuple[Array, Array, Array]:
    """Returns b in m⁴, db/dD in m² and d²b/dD²; zeros for D >= h², infinite or NaN for D <= 0."""
    inside = near > D
    ratio = jnp.where(inside, D / near, 1.0)
    log, gap = jnp.log(ratio), ratio - 1
    slope = -near * gap * (2 * log + gap / ratio)
    return -((near * gap) ** 2) * log, slope, jnp.where(inside, (1 / ratio - 1) * (1 / ratio + 3) - 2 * log, 0)


def pair_gradient(x: Float[Array, "k dim"], pair: Pair) -> tuple[Float[Array, ""], Float[Array, "k dim"]]:
    """Returns E in J and dE/dx in N of one pair."""
    delta, beta, *_ = closest(x, pair.stencil)
    value, slope, _ = barrier(summed(delta**2), pair.near)
    along = 2 * slope * beta[:, None] * delta
    if x.shape == (4, 3):
        m, m_slope, _ = _mollifier(x, pair.parallel)
        value, along = m * value, m * along + value * m_slope
    # Unused slots hold arbitrary vertices, possibly at the same position.
    used = pair.strength > 0
    return jnp.where(used, pair.strength * value, 0), jnp.where(used, pair.strength * along, 0)


def pair_hessian(x: Float[Array, "k dim"], pair: Pair) -> Float[Array, "s s"]:
    """Returns d²E/dx² in N/m of one pair, s = k dim."""
    delta, beta, e, inverse = closest(x, pair.stencil)
    value, slope, curvature = barrier(summed(delta**2), pair.near)
    gradient = (2 * beta[:, None] * delta).reshape(-1)
    A = (beta[:, None] * e[:, None, :] + pair.stencil.directions[:, :, None] * delta).reshape(len(e), -1)
    of_distance = 2 * jnp.kron(beta[:, None] * beta, jnp.eye(x.shape[1], dtype=x.dtype))
    of_distance -= 2 * jnp.einsum("ki,kl,lj->ij", A, inverse, A)
    whole = curvature * gradient[:, None] * gradient + slope * of_distance
    if x.shape == (4, 3):
        m, m_slope, m_curvature = _mollifier(x, pair.parallel)
        mixed = slope * gradient[:, None] * m_slope.reshape(-1)
        whole = m * whole + mixed + mixed.T + value * m_curvature
    return jnp.where(pair.strength > 0, pair.strength * whole, 0)


def normal_force(x: Float[Array, "k dim"], pair: Pair) -> tuple[Float[Array, ""], Array, Array]:
    """Returns the force in N that pushes the primitives apart, its unit direction, and the weights of the vertices."""
    delta, weights, *_ = closest(x, pair.stencil)
    D = summed(delta**2)
    used = (pair.strength > 0) & (pair.near > D)
    safe = jnp.where(used, D, pair.near)
    slope = pair.strength * barrier(safe, pair.near)[1]
    if x.shape == (4, 3):
        slope *= _mollifier(x, pair.parallel)[0]
    distance = jnp.sqrt(safe)
    return -2 * distance * slope, jnp.where(used, delta / distance, 0.0), weights


def _mollifier(x: Float[Array, "4 3"], parallel: Float[Array, ""]) -> tuple[Array, Array, Array]:
    """Returns m, dm/dx [4, 3] and d²m/dx² [12, 12] for the edges of x = (a, b, c, d); m = 1 for other pairs."""
    u, v = x[1] - x[0], x[3] - x[2]
    uu, uv, vv = summed(u * u), summed(u * v), summed(v * v)
    mollified = parallel > 0
    scale = jnp.where(mollified, parallel, 1.0)
    ratio = (uu * vv - uv**2) / scale
    inside = mollified & (ratio < 1)
    first = jnp.where(inside, (2 - 2 * ratio) / scale, 0)
    second = jnp.where(inside, -2 / scale**2, 0)
    c_u, c_v = 2 * (vv * u - uv * v), 2 * (uu * v - uv * u)
    gradient = jnp.stack([-c_u, c_u, -c_v, c_v])
    one = jnp.eye(3, dtype=x.dtype)
    of_u, of_v = 2 * (vv * one - v[:, None] * v), 2 * (uu * one - u[:, None] * u)
    both = 4 * u[:, None] * v - 2 * uv * one - 2 * v[:, None] * u
    sign = jnp.array([[1, -1], [-1, 1]], x.dtype)
    curved = jnp.block([[jnp.kron(sign, of_u), jnp.kron(sign, both)], [jnp.kron(sign, both.T), jnp.kron(sign, of_v)]])
    flat = gradient.reshape(-1)
    return (
        jnp.where(inside, (2 - ratio) * ratio, 1.0),
        first * gradient,
        second * flat[:, None] * flat + first * curved,
    )


def _sliding_hessian(x: Float[Array, "k dim"], data: tuple[Slip, Array]) -> Float[Array, "s s"]:
    slip, weights = data
    of_point = jax.hessian(lambda point: friction_energy(point, slip))(weights @ x)
    return jnp.einsum("a,ij,b->aibj", weights, of_point, weights).reshape(x.size, x.size)


SLIDING = MovingEnergy(
    elements=lambda x, step, data: data[0],
    describe=lambda x, elements, data: data[1],
    gradient=jax.value_and_grad(lambda x, data: friction_energy(data[1] @ x, data[0])),
    hessian=_sliding_hessian,
    longest=lambda x, step, elements, data: jnp.ones((), x.dtype),
)
"""Friction of points that are weighted sums of vertices. Its data are the elements with their slips and weights."""
