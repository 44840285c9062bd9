"""The mesh of a user's file in a simulation: its size, its held vertices and its materials by named sets."""

from typing import Any

from dln_jax.cli.arguments import names_listed, refuse_given
from dln_jax.data import meshes
from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.mesh.sets import values_by_set, vertices_in
from dln_jax.types import InputError

OPTIONS = ("scale", "pin", "youngs_modulus_of")
"""Options that only a mesh of one's own has."""


def own_mesh(options: Any, youngs_modulus: float) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Returns the arguments of a scene that --mesh and its options set, and statements about the file.

    Args:
        options: of the command line.
        youngs_modulus: of the elements that --youngs-modulus-of does not name, in Pa.

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
    except InputError as error:
        raise InputError(f"--mesh {error}") from None
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
    values = {}
    for item in names_listed(text):
        name, _, number = item.rpartition("=")
        try:
            values[name.strip()] = float(number)
        except ValueError:
            raise InputError(f"youngs-modulus-of is {text!r:.60}; expected SET=PA, separated by commas") from None
    return values
