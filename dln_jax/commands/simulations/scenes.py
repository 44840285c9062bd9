"""Scenes of `simulate` from options: an example and its stepper, with a user's own mesh and loads on its named sets."""

import inspect
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.commands.simulate import Arguments
from dln_jax.data import meshes
from dln_jax.errors import require_memory, require_within
from dln_jax.precision import data_type
from dln_jax.runs.arguments import names_listed, numbers_of, pairs_of, refuse_given
from dln_jax.softbody.examples import EXAMPLES, Example
from dln_jax.softbody.integrators import INTEGRATORS
from dln_jax.softbody.mesh.files import require_meshio
from dln_jax.softbody.mesh.mesh import Mesh, components, overlaps, values_by_set, vertices_in
from dln_jax.softbody.mesh.surfaces import facet_points, facets_in, inner_surface
from dln_jax.softbody.step import Stepper, make_step
from dln_jax.softbody.terms.loads import point_force, pressure, traction
from dln_jax.softbody.terms.strain_energies import corotated, neo_hookean, st_venant_kirchhoff, stable_neo_hookean
from dln_jax.softbody.terms.term import Term
from dln_jax.types import InputError, require_positive

MATERIALS = {
    energy.__name__.replace("_", "-"): energy
    for energy in (stable_neo_hookean, neo_hookean, st_venant_kirchhoff, corotated)
}
LARGEST_SIZE = 10.0
"""Longer meshes, m, are probably in millimetres."""
INNER = "inner"
"""Name of the walls of all closed cavities."""


class PreparedScene(NamedTuple):
    """A scene with its stepper, ready to simulate."""

    name: str
    example: Example
    stepper: Stepper
    dt: float
    """Time step, s."""
    steps: int
    statements: tuple[str, ...]
    """Notes on what the reader of the mesh left out or repaired."""


def prepare(options: Arguments, name: str) -> PreparedScene:
    """Builds a scene and its stepper with the options set on the command line.

    Raises:
        InputError: an option that the scene does not have, options that exclude each other, or an invalid value.
    """
    scene = EXAMPLES[name]
    known = inspect.signature(scene).parameters
    names = ("cells", "dimension", "youngs_modulus", "poisson_ratio", "order", "mesh")
    choices: dict[str, Any] = {name: getattr(options, name) for name in names}
    choices["strain_energy"] = options.material and MATERIALS[options.material]
    choices |= {"mixed": options.mixed or None, "contact": options.contact or None, "held": options.pin}
    choices = {name: value for name, value in choices.items() if value is not None}
    if options.mixed and options.order != 2:
        raise InputError("--mixed needs --order 2: mixed elements are quadratic")
    if unknown := [choice for choice in choices if choice not in known]:
        option = {"strain_energy": "material", "held": "pin"}.get(unknown[0], unknown[0].replace("_", "-"))
        raise InputError(f"the {name} scene has no --{option}; leave it out")
    if options.mesh is not None and (beside := [name for name in ("cells", "dimension") if name in choices]):
        raise InputError(f"--{beside[0]} sets the scene's own mesh; leave out either it or --mesh")
    modulus = choices.get("youngs_modulus", getattr(known.get("youngs_modulus"), "default", 0.0))
    from_file, statements = own_mesh(options, modulus)
    choices |= {name: value for name, value in from_file.items() if name in known}
    if "held" in from_file and "held" not in known:
        statements = (*statements, f"the {name} scene holds no vertices: the file's `held` is not used")
    example = scene(**choices)
    params = in_precision(example.scene.params, data_type(options.precision))
    example = example._replace(scene=example.scene._replace(params=params))
    if options.vtu:
        require_meshio("--vtu")
    dt = example.dt if options.dt is None else options.dt
    seconds = example.seconds if options.seconds is None else options.seconds
    require_positive(dt=dt, seconds=seconds)
    if dt > seconds:
        raise InputError(f"--seconds is {seconds} and --dt {dt}; expected a duration of at least one time step")
    steps = round(seconds / dt)
    require_within({"steps (--seconds / --dt)": steps})
    # Positions and velocities of every step in float64, held twice while chunks are concatenated.
    require_memory(f"a motion of {steps:,} steps", 32.0 * steps * example.scene.mesh.vertices.size)
    stepper = make_step(example.scene, dt, INTEGRATORS[options.integrator])
    return PreparedScene(name, example, stepper, dt, steps, statements)


def announce(prepared: PreparedScene, options: Arguments) -> None:
    """Prints size and settings of a scene, and what is suspicious about its mesh."""
    mesh = prepared.example.scene.mesh
    pieces, size = int(components(mesh).max()) + 1, np.ptp(mesh.vertices, axis=0)
    kind = "" if mesh.midsides is None else "mixed quadratic " if options.mixed else "quadratic "
    print(
        f"{prepared.name}: {len(mesh.vertices)} vertices, {len(mesh.elements)} {kind}elements in {pieces} "
        f"component{'s' * (pieces > 1)}, {' x '.join(f'{length:.4g}' for length in size)} m, "
        f"{int(prepared.example.scene.free.sum())} unknowns; {options.integrator}, dt {prepared.dt:.4g} s, "
        f"{options.precision}"
    )
    for statement in prepared.statements:
        print(statement)
    words = []
    for name, part in mesh.sets.items():
        elements = f", {len(part.elements)} elements" if len(part.elements) else ""
        words.append(f"{name} ({len(part.vertices)} vertices{elements})")
    if words:
        print(f"named sets: {', '.join(words)}")
    if pieces > 1 and not options.contact:
        loose = "no two elements share a vertex" if pieces == len(mesh.elements) else f"{pieces} parts share no vertex"
        print(
            f"warning: {loose}: they move apart, or through one another; add --contact to keep them apart, or, if the "
            "body is one, merge vertices at the same position before you save the mesh"
        )
    if size.max() > LARGEST_SIZE:
        print(
            f"warning: the body is {size.max():.4g} m long; expected lengths in metres: if the mesh is in millimetres, "
            "add --scale 0.001"
        )
    if mesh.turned:
        print(f"{mesh.turned} of {len(mesh.elements)} elements were inverted and have been turned")
    if count := len(overlaps(mesh)):
        facets = "edges" if mesh.dimension == 2 else "triangles"
        print(f"elements overlap at {count} of their {facets}: there, mass and stiffness add up")


def in_precision(tree: Any, precision: Any) -> Any:
    """Casts the floating-point arrays of a tree to this precision."""
    return jax.tree.map(lambda leaf: leaf.astype(precision) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf, tree)


def own_mesh(options: Arguments, youngs_modulus: float) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Returns the arguments of a scene that --mesh and its options set, and statements about the file.

    Args:
        youngs_modulus: modulus of the elements that --youngs-modulus-of does not name, Pa.

    Raises:
        InputError: an option without --mesh, a file that cannot be read, or a set that does not exist.
    """
    if options.mesh is None:
        refuse_given(options, ("scale", "pin", "youngs_modulus_of", "pressure", "load"), "an option of --mesh")
        return {}, ()

    def by_set(option: str, separator: str, count: int) -> dict[str, tuple[float, ...]]:
        """Numbers of an option by named set."""
        words = (getattr(options, option) or "").split(separator)
        option = f"--{option.replace('_', '-')}"
        pairs = pairs_of(option, [word for word in words if word.strip()])
        return {name: numbers_of(f"{option} {name}", text, [count]) for name, text in pairs.items()}

    try:
        mesh, held, statements = meshes.load(options.mesh, 1.0 if options.scale is None else options.scale)
        if options.pin is not None:
            if not (names := names_listed(options.pin)):
                raise InputError("--pin names no set; name one, or leave it out")
            held = vertices_in(mesh, names)
        choices: dict[str, Any] = {"mesh": mesh} if held is None else {"mesh": mesh, "held": held}
        if moduli := by_set("youngs_modulus_of", ",", 1):
            values = {name: modulus for name, (modulus,) in moduli.items()}
            choices["youngs_modulus"] = values_by_set(mesh, youngs_modulus, values)
        pressures, forces = by_set("pressure", ",", 1), by_set("load", ";", mesh.dimension)
        if pressures or forces:
            # The scene may turn the mesh into a quadratic one, for which the loads differ.
            choices["loads"] = lambda mesh: _loads(mesh, pressures, forces)
            choices["loads"](mesh)
    except InputError as error:
        raise InputError(f"--mesh {error}") from None
    return choices, statements


def _loads(mesh: Mesh, pressures: dict[str, tuple[float, ...]], forces: dict[str, tuple[float, ...]]) -> list[Term]:
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
