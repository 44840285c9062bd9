"""The mesh of a user's file in a simulation: its held vertices, materials, pressures and loads by named sets."""

from typing import Any

import numpy as np

from dln_jax.data import meshes
from dln_jax.runs.arguments import names_listed, refuse_given
from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.mesh.sets import values_by_set, vertices_in
from dln_jax.softbody.mesh.surfaces import facet_points, facets_in, inner_surface
from dln_jax.softbody.terms.loads import point_force, traction
from dln_jax.softbody.terms.pressure import pressure
from dln_jax.softbody.terms.term import Term
from dln_jax.types import InputError, require_once

INNER = "inner"
"""Name of the walls of all closed cavities."""
OPTIONS = ("scale", "pin", "youngs_modulus_of", "pressure", "load")
"""Options that exist only with --mesh."""


def own_mesh(options: Any, youngs_modulus: float) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Returns the arguments of a scene that --mesh and its options set, and statements about the file.

    Args:
        youngs_modulus: modulus of the elements that --youngs-modulus-of does not name, Pa.

    Raises:
        InputError: an option without --mesh, a file that cannot be read, or a set that does not exist.
    """
    if options.mesh is None:
        refuse_given(options, OPTIONS, "an option of --mesh")
        return {}, ()
    try:
        mesh, held, statements = meshes.load(options.mesh, 1.0 if options.scale is None else options.scale)
        if options.pin is not None:
            if not (names := names_listed(options.pin)):
                raise InputError("--pin names no set; name one, or leave it out")
            held = vertices_in(mesh, names)
        choices = {"mesh": mesh, "held": held}
        if options.youngs_modulus_of is not None:
            choices["youngs_modulus"] = values_by_set(mesh, youngs_modulus, _moduli(options.youngs_modulus_of))
        pressures, forces = _numbers("pressure", options.pressure, ",", 1), _forces(mesh, options.load)
        # The scene may turn the mesh into a quadratic one, for which the loads differ.
        choices["loads"] = lambda mesh: _loads(mesh, pressures, forces)
        choices["loads"](mesh)
    except InputError as error:
        raise InputError(f"--mesh {error}") from None
    if not (pressures or forces):
        del choices["loads"]
    return {name: value for name, value in choices.items() if value is not None}, statements


def listed(mesh: Mesh) -> str:
    """The named sets of a mesh, in one line."""
    words = []
    for name, part in mesh.sets.items():
        elements = f", {len(part.elements)} elements" if len(part.elements) else ""
        words.append(f"{name} ({len(part.vertices)} vertices{elements})")
    return ", ".join(words)


def _moduli(text: str) -> dict[str, float]:
    """Young's modulus by set, from text such as tip=1e6,core=5e6."""
    return {name: values[0] for name, values in _numbers("youngs-modulus-of", text, ",", 1).items()}


def _forces(mesh: Mesh, text: str | None) -> dict[str, list[float]]:
    """Total force in N by set, from text such as tip=0,-5;side=2,0."""
    return _numbers("load", text, ";", mesh.dimension)


def _numbers(option: str, text: str | None, separator: str, count: int) -> dict[str, list[float]]:
    """Parses `count` numbers for each set."""
    values = {}
    items = [item for part in (text or "").split(separator) if (item := part.strip())]
    require_once(f"--{option}", [item.rpartition("=")[0].strip() for item in items])
    for item in items:
        name, _, numbers = item.rpartition("=")
        if name.strip() in values:
            raise InputError(f"--{option} names '{name.strip()}' twice; name each set once")
        try:
            values[name.strip()] = [float(number) for number in numbers.split(",")]
        except ValueError:
            values[name.strip()] = []
        if not name.strip() or len(values[name.strip()]) != count or not np.isfinite(values[name.strip()]).all():
            what = "SET=" + ("PA", "FX,FY", "FX,FY,FZ")[count - 1]
            raise InputError(f"--{option} is {text!r:.60}; expected {what}, separated by '{separator}'")
    return values


def _loads(mesh: Mesh, pressures: dict[str, list[float]], forces: dict[str, list[float]]) -> list[Term]:
    terms = []
    for name, (value,) in pressures.items():
        facets = inner_surface(mesh) if name == INNER and name not in mesh.sets else facets_in(mesh, name)
        try:
            terms.append(pressure(mesh, facets, pressure=value, cap=mesh.midsides is None, name=f"pressure-{name}"))
        except InputError as error:
            raise InputError(f"pressure on '{name}': {error}") from None
    for name, force in forces.items():
        vertices = vertices_in(mesh, [name])
        try:
            facets = facets_in(mesh, name)
        except InputError:
            share = np.array(force) / len(vertices)
            terms.append(point_force(mesh, vertices, share, name=f"load-{name}"))
            continue
        _, normals = facet_points(mesh.vertices[facets])
        area = np.linalg.norm(normals, axis=2).sum()
        terms.append(traction(mesh, facets, np.array(force) / area, name=f"load-{name}"))
    return terms
