"""Scene of a soft body: a mesh, its energy terms, the held vertices and all parameters.

Only the terms of a scene are traced. Everything in `Params` is differentiable and can be vmapped.
"""

import reprlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dln_jax.softbody.contact.barrier import Contact
from dln_jax.softbody.contact.crossings import crossings
from dln_jax.softbody.mesh.mesh import Mesh, indices_of, lumped_masses
from dln_jax.softbody.terms.term import Context, Pose, Term
from dln_jax.solvers.elements.energies import ElementEnergy, value
from dln_jax.solvers.elements.moving import Lists, MovingEnergy, lists_between, moving_gradient
from dln_jax.types import InputError


class Params(NamedTuple):
    """Parameters of a motion, apart from its state and its controls."""

    rest: Float[Array, "n dim"]
    """Rest shape in m."""
    masses: Float[Array, " n"]
    """Masses of the vertices in kg."""
    terms: dict[str, Any]
    """Parameters of the terms, by name."""

    @property
    def poses(self) -> dict[str, Pose]:
        """Poses of rigid surfaces by the names of their terms."""
        places = {name: getattr(of, "pose", None) for name, of in self.terms.items()}
        return {name: pose for name, pose in places.items() if pose is not None}


class SoftScene(NamedTuple):
    """A soft body with its energy terms, held vertices and default parameters."""

    mesh: Mesh
    terms: tuple[Term, ...]
    held: Int[np.ndarray, " k"]
    """Vertices with a prescribed motion: from `Motion`, or with their velocity in `State.v`."""
    params: Params
    """Default parameters."""
    contacts: tuple[Contact, ...] = ()
    """Barrier contacts, between bodies or with obstacles."""

    @property
    def free(self) -> Bool[np.ndarray, "n dim"]:
        """Mask of the free coordinates."""
        free = np.ones(self.mesh.vertices.shape, bool)
        free[self.held] = False
        return free


class Previous(NamedTuple):
    """The previous state, for two-step methods."""

    x: Float[Array, "n dim"]
    v: Float[Array, "n dim"]
    known: Bool[Array, ""]
    """False before the first step, which is then a step of backward Euler."""


class Growth(NamedTuple):
    """Energy created by the steps of a motion, in J."""

    created: Float[Array, ""]
    """Energy created since its minimum: max(created + energy_growth, 0), step by step."""
    at_hand: Float[Array, ""]
    """Largest energy available to a step so far, excluding the created energy."""


class State(NamedTuple):
    """Positions and velocities of the vertices."""

    x: Float[Array, "n dim"]
    """In m."""
    v: Float[Array, "n dim"]
    """In m/s; for held vertices the prescribed velocity."""
    previous: Previous | None = None
    """Previous state, for two-step methods."""
    growth: Growth | None = None
    """Energy created so far, for `Info.converged` to detect slow divergence; `None` judges single steps only."""
    poses: tuple[Bool[Array, ""], dict[str, Pose]] | None = None
    """Flag for known poses, and the poses of rigid surfaces from the parameters of the previous step; friction uses
    them for the surface motion. In a step from unknown poses, such as the first, surfaces are at rest."""


def make_scene(
    mesh: Mesh,
    terms: Sequence[Term],
    *,
    density: float | None = None,
    masses: Any = None,
    held: Any = (),
    contacts: Sequence[Contact] = (),
) -> SoftScene:
    """Builds a scene with its default parameters.

    Args:
        mesh: its vertices are the rest shape.
        terms: energy terms of the body.
        density: in kg/m³ (kg/m² in the plane), for the masses of the vertices; by default 1000.
        masses: masses of the vertices in kg, one for all or [n], instead of a density.
        held: vertices with a prescribed motion: indices [k], or a boolean mask [n].
        contacts: barrier contacts with obstacles and between bodies; without them, bodies pass through each other.

    Raises:
        InputError: a name is used twice, a part was made for another mesh, an index or mass is out of range, both
            density and masses are given, no vertex is free, or surfaces in contact cross in the rest shape.
    """
    n = len(mesh.vertices)
    terms = tuple(terms)
    names = [term.name for term in terms] + [contact.name for contact in contacts]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"two terms are named '{twice[0]}'; give each its own name")
    for part in (*terms, *contacts):
        of = mesh if part.mesh is None else part.mesh
        if not (np.array_equal(of.vertices, mesh.vertices) and np.array_equal(of.nodes, mesh.nodes)):
            raise InputError(f"'{part.name}' was made for another mesh; make it from the mesh of the scene")
    for term in terms:
        if len(wrong := np.argwhere((term.indices < 0) | (term.indices >= n))):
            vertex = term.indices[tuple(wrong[0])]
            raise InputError(f"term '{term.name}', element {wrong[0][0]} names vertex {vertex}; expected 0..{n - 1}")
    held = indices_of("held", held, n)
    if len(held) == n:
        raise InputError(f"held names all {n} vertices; expected at least one free vertex")
    if masses is not None and density is not None:
        raise InputError("masses and density are both set; leave out one of them")
    density = 1000.0 if density is None else density
    masses = lumped_masses(mesh, density) if masses is None else np.broadcast_to(np.asarray(masses, float), n)
    if len(bad := np.flatnonzero(~(np.isfinite(masses) & (masses > 0)))):
        raise InputError(f"the mass of vertex {bad[0]} is {masses[bad[0]]} kg; expected a positive number")
    if contacts and (pairs := crossings(mesh, mesh.vertices)):
        one, other = map(list, pairs[0])
        raise InputError(
            f"{len(pairs)} pair(s) of the surface cross, the first with the vertices {one} and {other}; "
            "move the bodies apart, or leave out their contact"
        )
    parameters = {part.name: part.parameters for part in (*terms, *contacts)}
    params = Params(jnp.asarray(mesh.vertices), jnp.asarray(masses), parameters)
    return SoftScene(mesh, terms, held, params, tuple(contacts))


def with_parameters(params: Params, **terms: Mapping[str, Any]) -> Params:
    """Returns the parameters with some values replaced: `with_parameters(params, elastic={"youngs_modulus": 2e5})`.

    Args:
        terms: new values by term and parameter name; numbers or arrays, traced or not. A name may also refer to a value
            within a parameter, such as the `centre` of an obstacle's shape.

    Raises:
        InputError: the scene does not have such a term or parameter.
    """
    replaced = dict(params.terms)
    for name, values in terms.items():
        if name not in replaced:
            raise InputError(f"the scene has no term '{name}'; expected one of {', '.join(replaced)}")
        for field, new in values.items():
            like = partial(_like, name, field, new, params)
            changed = _with_value(replaced[name], field, like)
            if changed is None:
                fields = ", ".join(_names(replaced[name]))
                raise InputError(f"term '{name}' has no parameter '{field}'; expected one of {fields}")
            replaced[name] = changed
    return params._replace(terms=replaced)


def _with_value(record: Any, field: str, value_for: Callable[[Any], Any]) -> Any:
    """Returns the record with a new value of a field, also in nested records; `None` without such a field."""
    if field in record._fields:
        return record._replace(**{field: value_for(getattr(record, field))})
    for place, inner in record._asdict().items():
        changed = _with_value(inner, field, value_for) if hasattr(inner, "_fields") else None
        if changed is not None:
            return record._replace(**{place: changed})
    return None


def _names(record: Any) -> Iterator[str]:
    """Yields the names of a record's values, also in nested records."""
    for name, inner in record._asdict().items():
        if hasattr(inner, "_fields"):
            yield from _names(inner)
        else:
            yield name


def _like(name: str, field: str, value: Any, params: Params, before: Any) -> Any:
    """Converts a new parameter value to the precision of the scene; refuses a wrong shape."""
    if not isinstance(before, Array | np.ndarray | float | int):
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, params.rest.dtype), value)
    what = f"term '{name}': {field}"
    try:
        array = jnp.asarray(value, params.rest.dtype)
    except (TypeError, ValueError):
        raise InputError(f"{what} is {reprlib.repr(value)}; expected numbers") from None
    shape, elements = np.shape(before), np.shape(array)
    # A number may replace one value per element, and vice versa; vectors keep their length.
    if elements != shape and not (() in (shape, elements) and len(shape) + len(elements) == 1):
        raise InputError(f"{what} has shape {elements}; expected {shape}")
    return array


def element_energies(scene: SoftScene) -> tuple[ElementEnergy, ...]:
    """Returns the terms in the form that the solver takes."""
    return tuple(ElementEnergy(term.energy, term.indices, term.unrolled, term.weights) for term in scene.terms)


def prepare(
    scene: SoftScene,
    params: Params,
    x: Float[Array, "n dim"],
    *,
    dt: Any = jnp.inf,
    control: Any = None,
    **settings: Any,
) -> tuple[Any, ...]:
    """Returns the data of all terms' elements for a step of dt in s that starts at x; dt = inf is a static solve.

    The settings are `lag` and `before` of `Context`.
    """
    context = Context(params.rest, params.masses, x, jnp.asarray(dt, x.dtype), **settings)
    controls = _by_term(scene, control)
    return tuple(
        term.prepare(params.terms[term.name], context._replace(control=controls(term.name))) for term in scene.terms
    )


def _by_term(scene: SoftScene, control: Any) -> Callable[[str], Any]:
    """Returns term name -> control: the array of the only actuator, or an entry of a dict."""
    driven = [term.name for term in scene.terms if term.control is not None]
    if control is None:
        return lambda _: None
    if not isinstance(control, Mapping):
        if len(driven) != 1:
            several = f"the actuators {', '.join(driven)}; pass a dict of arrays by these names"
            none = "no actuator; pass no control, or leave out a term's value to control it"
            raise InputError(f"the control is one array, but the scene has {several if driven else none}")
        return {driven[0]: control}.get
    if unknown := [name for name in control if name not in driven]:
        known = f"expected {', '.join(driven)}" if driven else "it has none: leave out a term's value to control it"
        raise InputError(f"the control names '{unknown[0]}', which is not an actuator of the scene; {known}")
    return control.get


def prepare_contacts(
    scene: SoftScene,
    params: Params,
    x: Float[Array, "n dim"],
    *,
    dt: Any = jnp.inf,
    **settings: Any,
) -> tuple[Any, ...]:
    """Returns the data of the contacts' energies for a step of dt in s that starts at x, like `prepare`."""
    context = Context(params.rest, params.masses, x, jnp.asarray(dt, x.dtype), **settings)
    return tuple(data for contact in scene.contacts for data in contact.prepare(params.terms[contact.name], context))


def contact_energies(scene: SoftScene) -> tuple[MovingEnergy, ...]:
    """Returns the contacts in the form that the solver takes."""
    return tuple(energy for contact in scene.contacts for energy in contact.energies)


def least_distance(
    scene: SoftScene, x: Float[Array, "n dim"], lists: Lists, data: Sequence[Any]
) -> Float[Array, ""] | None:
    """Returns the smallest distance in m over all contacts; `None` for a scene without contacts."""
    if not scene.contacts:
        return None
    starts = np.cumsum([0, *(len(contact.energies) for contact in scene.contacts)]).tolist()
    nearest = [
        contact.least_distance(x, lists[start], data[start])
        for contact, start in zip(scene.contacts, starts, strict=False)
    ]
    return jnp.min(jnp.stack(nearest))


def potential(scene: SoftScene, x: Float[Array, "n dim"], params: Params, control: Any = None) -> Array:
    """Returns V(x) in J, the stored energy, for energy plots; dissipative terms are evaluated for rest at x."""
    stored = value(element_energies(scene), x, prepare(scene, params, x, control=control))
    energies, data = contact_energies(scene), prepare_contacts(scene, params, x)
    return stored + moving_gradient(energies, x, lists_between(energies, x, jnp.zeros_like(x), data), data)[0]
