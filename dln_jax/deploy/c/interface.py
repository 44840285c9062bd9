"""What an exported source declares: functions and their signatures, and the description that states its sizes."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dln_jax.deploy.c.text import PRECISIONS
from dln_jax.deploy.exports import AGAIN, read_export
from dln_jax.types import InputError

FUNCTION = "differential-network"
FORMAT = 2
"""Version of the names and signatures in exported sources, and of their description."""
LARGEST = 10_000
"""Of the sizes d, n and m."""
_STATE = "const {real} q[{d}], const {real} qd[{d}]"
_DYNAMICS = {
    "inverse_dynamics": ("void", _STATE + ", const {real} qdd[{d}], {real} tau[{d}]"),
    "forward_dynamics": ("void", _STATE + ", const {real} tau[{d}], {real} qdd[{d}]"),
}
_ENERGY = {**_DYNAMICS, "energy": ("{real}", _STATE)}
_MASS = {**_ENERGY, "mass_matrix": ("void", "const {real} q[{d}], {real} M[{d} * {d}]")}
_MASS_OF_STATE = {**_ENERGY, "mass_matrix": ("void", _STATE + ", {real} M[{d} * {d}]")}
_FUNCTION = {
    "value": ("void", "const {real} x[{n}], {real} y[{m}]"),
    "value_and_jacobian": ("void", "const {real} x[{n}], {real} y[{m}], {real} jacobian[{m} * {n}]"),
}
_DECLARED = {
    **dict.fromkeys(("structured-delan", "structured-hnn", "trigonometric"), _MASS),
    **dict.fromkeys(("black-box-delan", "black-box-hnn"), _MASS_OF_STATE),
    "feed-forward": _DYNAMICS,
    FUNCTION: _FUNCTION,
}
"""Result and arguments of each function, by kind of model."""


def interface(name: str, kind: str, precision: str, sizes: dict[str, Any], version: str) -> dict[str, Any]:
    """The description of an exported source, JSON values, with result and arguments of each function in C.

    `sizes` are d, or n and m of a differential network; `version` is that of the release that wrote the source.

    Raises:
        InputError: no such kind or precision, or sizes that are no counts up to 10,000.
    """
    if kind not in _DECLARED:
        raise InputError(f"kind is {kind!r}; expected one of {', '.join(_DECLARED)}")
    if precision not in PRECISIONS:
        raise InputError(f"precision is {precision!r}; expected f32 or f64")
    for key, size in sizes.items():
        if type(size) is not int or not 1 <= size <= LARGEST:
            raise InputError(f"{key} is {size!r}; expected a whole number from 1 to {LARGEST}")
    declared = _signatures(kind, real=PRECISIONS[precision][1], **sizes)
    stated = {"format": FORMAT, "version": version, "name": name, "kind": kind, "precision": precision}
    return {**stated, **sizes, "functions": declared}


def definitions(kind: str, bodies: Mapping[str, str]) -> str:
    """The functions of a source from the bodies by name; `$name` is left to fill in."""
    declared = _signatures(kind, real="real", d="D", n="INPUTS", m="OUTPUTS")
    return "".join(
        f"\n{result} ${{name}}_{function}({arguments})\n{{\n{bodies[function]}}}\n"
        for function, (result, arguments) in declared.items()
    )


def _signatures(kind: str, **names: Any) -> dict[str, list[str]]:
    return {function: [text.format(**names) for text in each] for function, each in _DECLARED[kind].items()}


def read_interface(directory: Path, name: str) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The description of an exported model, nothing in it merely believed, and the header and source that it is of.

    Raises:
        InputError: a file is missing or altered, the format is another, or what is stated contradicts itself.
    """
    path = directory / f"{name}.json"
    values, files = read_export(path, (f"{name}.h", f"{name}.c"))
    if values.get("format") != FORMAT:
        raise InputError(f"{path}: C format {values.get('format')!r}; this release reads format {FORMAT}, so {AGAIN}")
    kind, precision, version = (str(values.get(key)) for key in ("kind", "precision", "version"))
    sizes = {key: values.get(key) for key in (("n", "m") if kind == FUNCTION else ("d",))}
    try:
        expected = interface(name, kind, precision, sizes, version)
    except InputError as error:
        raise InputError(f"{path}: {error}; {AGAIN}") from error
    for key in (*expected, *values):
        if values.get(key) != expected.get(key):
            stated, wanted = f"{values.get(key)!r:.60}", f"{expected.get(key)!r:.60}"
            raise InputError(f"{path}: {key} is {stated}, expected {wanted}; {AGAIN}")
    return expected, files
