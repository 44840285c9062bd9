"""A trained model as C99 source without dependencies, a demo of it, and what builds both.

The source holds constant tables and functions of one state: no allocation, no mutable state outside the stack, no
library but <math.h>. The same model, name and precision give the same files, byte for byte.
"""

import importlib.metadata
from functools import partial
from pathlib import Path
from typing import Any

from dln_jax.data.schema import needs_from_json
from dln_jax.deploy.c import black_box as c_black_box
from dln_jax.deploy.c import function as c_function
from dln_jax.deploy.c import structured as c_structured
from dln_jax.deploy.c import trigonometric as c_trigonometric
from dln_jax.deploy.c.activations import EXPORTABLE
from dln_jax.deploy.c.demo import cmake, demo
from dln_jax.deploy.c.interface import FORMAT, FUNCTION, interface
from dln_jax.deploy.c.library import helpers
from dln_jax.deploy.c.text import PRECISIONS, check_name, comment, fill
from dln_jax.deploy.exports import described, write_exports
from dln_jax.types import InputError
from dln_jax.zoo.catalogue import entry_of
from dln_jax.zoo.descriptions import Description, require_complete
from dln_jax.zoo.run import load

SOURCES = {
    "structured-delan": c_structured.source,
    "structured-hnn": c_structured.source,
    "black-box-delan": c_black_box.source,
    "black-box-hnn": c_black_box.source,
    "trigonometric": c_trigonometric.source,
    "feed-forward": c_function.feed_forward_source,
}
_MEANINGS = {
    "inverse_dynamics": "Generalised force tau that the motion (q, qd, qdd) takes, friction included.",
    "forward_dynamics": "Acceleration qdd of the state (q, qd) under the generalised force tau.",
    "energy": "Energy T + V of the state, in J.",
    "mass_matrix": "Mass matrix M, row by row.",
    "value": "y at x.",
    "value_and_jacobian": "y and dy/dx at x; element (k, j) of the Jacobian at k * {n} + j is dy_k/dx_j.",
}
_PROMISES = """Functions of one state, which keep their workspace on the stack and may run in several threads.
Arrays that are written must not overlap others. What is not finite in a state gives results that are not."""
_NEEDED = """C99; needs <math.h> and nothing else. Fastest with -O3 for the processor at hand (gcc: -march=native);
results do not rely on reordered arithmetic (-ffast-math)."""


def export_c(
    description: Description,
    parameters: Any,
    directory: str | Path,
    *,
    name: str = "model",
    precision: str | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Writes NAME.h, NAME.c, NAME_demo.c, NAME.json and CMakeLists.txt, and returns their paths.

    Args:
        description: of the model, as `zoo.describe` gives and `model.json` holds it.
        parameters: of the model; layers with the members of an ensemble first, for a differential network.
        directory: is created where it is missing.
        name: a C name; every file and public function starts with it.
        precision: f32 or f64; by default that of the training.
        overwrite: replace files that exist.

    Raises:
        InputError: a model that has no C export, a name that is none in C, files that exist, or the folder of a run,
            whose files are never replaced.
    """
    texts = source_files(description, parameters, name=check_name(name), precision=precision)
    return write_exports(Path(directory), texts, overwrite=overwrite)


def export_run(directory: str | Path, out: str | Path, **keywords: Any) -> list[Path]:
    """`export_c` of the model in a run's folder, of `train_delan`, `train_hnn` or `train_diffnet`."""
    run = load(directory)
    return export_c(run.description, run.parameters, out, **keywords)


def source_files(description: Description, parameters: Any, *, name: str, precision: str | None) -> dict[str, bytes]:
    """Content of each file, by its name."""
    kind, precision = str(description.get("name")), precision or str(description.get("precision"))
    if kind not in SOURCES and kind != FUNCTION:
        raise InputError(f"a {kind} has no C export; exportable are {', '.join((*SOURCES, FUNCTION))}")
    require_complete(description, entry_of(kind).factory)
    if description.get("friction_width") and description["needs"]["friction"]:
        raise InputError("a friction that depends on q has no C export; train with one coefficient per coordinate")
    activation = str(description.get("activation", "tanh"))
    if activation not in EXPORTABLE:
        raise InputError(f"activation is '{activation}'; C export knows {', '.join(EXPORTABLE)}")
    if kind == FUNCTION:
        sizes = {"n": parameters[0][0].shape[1], "m": parameters[-1][0].shape[2]}
        body = partial(c_function.source, parameters)
        about = f"{sizes['n']} inputs x, {sizes['m']} outputs y"
    else:
        needs = needs_from_json(description["needs"])
        sizes = {"d": needs.degrees_of_freedom}
        body = partial(SOURCES[kind], description, parameters, needs)
        units = ", ".join(f"{joint} ({'rad' if joint == 'revolute' else 'm'})" for joint in needs.joints)
        about = f"Joints: {units}; {'with' if needs.friction else 'without'} friction"
    version = importlib.metadata.version("dln-jax")
    stated = interface(name, kind, precision, sizes, version)
    declared = stated["functions"]
    written_by = f"Written by dln-jax {version}, C format {FORMAT}, from a {kind}.\n{about}."
    constants, _, functions = fill(body(precision), precision, name=name).partition("\n")
    about = comment(f"{name}.c", written_by, _NEEDED)
    texts = {
        f"{name}.h": _header(name, written_by, declared, sizes),
        f"{name}.c": f'{about}#include <math.h>\n\n#include "{name}.h"\n\ntypedef {PRECISIONS[precision][1]} real;\n\n'
        f"{constants}\n{helpers(functions, precision, activation)}{functions}",
        f"{name}_demo.c": demo(name, declared, sizes, precision),
        "CMakeLists.txt": cmake(name),
    }
    files = {file_name: text.encode() for file_name, text in texts.items()}
    return {**files, f"{name}.json": described(stated, files)}


def _header(name: str, written_by: str, declared: dict[str, list[str]], sizes: dict[str, int]) -> str:
    units = "Units: q in rad or m, qd in 1/s and qdd in 1/s^2 of that, tau in N m or N.\n" * ("d" in sizes)
    about, guard = comment(f"{name}.h", written_by, units + _PROMISES), f"{name.upper()}_H"
    size_names = {"d": "DEGREES_OF_FREEDOM", "n": "INPUTS", "m": "OUTPUTS"}
    defines = "".join(f"#define {name.upper()}_{size_names[key]} {size}\n" for key, size in sizes.items())
    declarations = "".join(
        f"\n/* {_MEANINGS[function].format(**sizes)} */\n{result} {name}_{function}({arguments});\n"
        for function, (result, arguments) in declared.items()
    )
    return (
        f'{about}#ifndef {guard}\n#define {guard}\n\n{defines}\n#ifdef __cplusplus\nextern "C" {{\n#endif\n'
        f"{declarations}\n#ifdef __cplusplus\n}}\n#endif\n\n#endif\n"
    )
