"""The interface between a scene and a barrier contact, whatever touches."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.terms.term import NOT_NEGATIVE, POSITIVE, Context, Numbers, material
from dln_jax.solvers.elements.moving import Elements, MovingEnergy


class ContactParameters(NamedTuple):
    """Parameters of a barrier contact."""

    distance: Float[Array, ""]
    """h in m; surfaces repel each other when closer."""
    stiffness: Float[Array, ""]
    """kappa in Pa."""
    friction: Float[Array, ""] | None
    """Coulomb's coefficient, or `None`."""


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
    """Whether the set of elements changes during a motion."""

    @property
    def friction(self) -> tuple[MovingEnergy, ...]:
        """The friction energy, if the contact has one."""
        return self.energies[1:]


def contact_parameters(distance: float, stiffness: Numbers, friction: Numbers | None) -> ContactParameters:
    """Returns validated parameters."""
    return ContactParameters(
        jnp.asarray(distance, dtype=float),
        material("the stiffness of a contact", stiffness, 1, "contact", POSITIVE),
        None if friction is None else material("friction", friction, 1, "contact", NOT_NEGATIVE),
    )
