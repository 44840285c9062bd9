"""Interface of an exported source: signatures of its functions, their C declarations and the JSON description."""

import hashlib
import inspect
import json
from collections.abc import Callable, Mapping, Sequence
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import jax

from dln_jax.export.c.text import C_TYPES, check_name, kind_of
from dln_jax.files import read_json
from dln_jax.types import InputError, require_once

FORMAT = 6
"""Version of the names and signatures in exported sources and of the JSON description."""
Function = Callable[..., Any]


class Leaf(NamedTuple):
    """An array among the arguments or results of a C function."""

    name: str
    kind: str
    shape: tuple[int, ...]

    @property
    def described(self) -> str:
        """Name and shape, for messages and comments."""
        return f"{self.name} {list(self.shape)}" if self.shape else self.name


class Cost(NamedTuple):
    """Upper bounds on the cost of one call of a C function."""

    operations: int = 0
    """Floating-point operations, including those of the source's own elementary functions."""
    additions: int = 0
    """Additions and subtractions outside elementary functions; a multiply-add also counts as a multiplication."""
    multiplications: int = 0
    divisions: int = 0
    square_roots: int = 0
    functions: int = 0
    """Calls of elementary functions; sine and cosine of one number are one call."""
    stack_bytes: int = 0
    """Stack of an optimised build, including called functions."""
    unbounded_loops: int = 0
    """Loops without a bound on their iterations; the other numbers count one iteration of each."""


class Signature(NamedTuple):
    """Arguments, results and cost of a C function."""

    arguments: tuple[Leaf, ...]
    results: tuple[Leaf, ...]
    cost: Cost = Cost()

    @property
    def returns(self) -> bool:
        """True if the function returns its only result, a scalar, instead of writing to an array."""
        return [leaf.shape for leaf in self.results] == [()]

    @property
    def written(self) -> tuple[Leaf, ...]:
        """Results in arrays."""
        return () if self.returns else self.results


def signature_of(function: Function, examples: Sequence[Any], shapes: Any) -> Signature:
    """Returns the signature of a function, without costs, from example arguments and the shapes of its results.

    Arguments are named after the function's parameters, results after their keys (`result` without keys). Leaves of a
    tree also have the path of the leaf.
    """
    try:
        names = list(inspect.signature(function).parameters)
    except (ValueError, TypeError):
        names = []
    names += [f"argument_{k}" for k in range(len(names), len(examples))]
    arguments = [leaf for name, example in zip(names, examples, strict=False) for leaf in _leaves(name, example)]
    used = {leaf.name for leaf in arguments}
    results = [leaf._replace(name=f"{leaf.name}_result") if leaf.name in used else leaf for leaf in _leaves("", shapes)]
    for what, leaves in (("argument", arguments), ("result", results)):
        require_once(f"the list of {what}s", [check_name(leaf.name, f"{what} name") for leaf in leaves])
    return Signature(tuple(arguments), tuple(results))


def _leaves(name: str, tree: Any) -> list[Leaf]:
    leaves = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        whole = "_".join(filter(None, (name, jax.tree_util.keystr(path, simple=True, separator="_")))) or "result"
        whole = f"result_{whole}" if whole[:1].isdigit() else whole
        leaves.append(Leaf(whole, kind_of(jax.dtypes.canonicalize_dtype(leaf.dtype)), tuple(leaf.shape)))
    return leaves


def declaration(name: str, function: str, signature: Signature, real: str) -> str:
    """Returns the prototype of a function, without the semicolon."""
    kinds = {**C_TYPES, "real": real}

    def array(leaf: Leaf) -> str:
        return f"{kinds[leaf.kind]} {leaf.name}[{max(prod(leaf.shape), 1)}]"  # C has no empty arrays

    parameters = [
        f"const {array(leaf)}" if leaf.shape else f"{kinds[leaf.kind]} {leaf.name}" for leaf in signature.arguments
    ]
    returned = kinds[signature.results[0].kind] if signature.returns else "void"
    parameters += map(array, signature.written)
    return f"{returned} {name}_{function}({', '.join(parameters) or 'void'})"


def description(
    name: str, precision: str, version: str, functions: Mapping[str, Signature], header: bytes, source: bytes
) -> bytes:
    """Returns the JSON description of an export: its functions, and a digest of itself, the header and the source."""
    # JSON converts the tuples of leaves and shapes to lists.
    stated = {
        key: {"arguments": function.arguments, "results": function.results, **function.cost._asdict()}
        for key, function in functions.items()
    }
    facts = {"format": FORMAT, "version": version, "name": name, "precision": precision, "functions": stated}
    return json.dumps({**facts, "digest": _digest(facts, header, source)}, indent=2).encode() + b"\n"


def _digest(facts: Mapping[str, Any], header: bytes, source: bytes) -> str:
    return hashlib.sha256(json.dumps(facts).encode() + header + source).hexdigest()


def stated_costs(directory: str | Path, *, name: str = "model") -> dict[str, Cost]:
    """Returns the cost of one call of each function of an export.

    Raises:
        InputError: as for `load_c`.
    """
    return {key: signature.cost for key, signature in read_interface(Path(directory), name)[1].items()}


def read_interface(directory: Path, name: str) -> tuple[str, dict[str, Signature], dict[str, bytes]]:
    """Returns the precision and the signatures of an export, and its header and source, checked by their digest.

    The digest detects accidents, such as an interrupted export or an edited file, but no forgery.

    Raises:
        InputError: a file is missing or altered, or the format differs.
    """
    path = directory / f"{name}.json"
    stated = read_json(path, remedy="export it again, and keep its files together")
    if stated.get("format") != FORMAT:
        raise InputError(
            f"{path}: C format {stated.get('format')!r}; this release reads format {FORMAT}, so export it again"
        )
    try:
        files = {file.name: file.read_bytes() for file in (path.with_suffix(".h"), path.with_suffix(".c"))}
    except OSError as error:
        raise InputError(f"{error.filename}: cannot be read ({error.strerror}); export it again") from error
    if stated.pop("digest", None) != _digest(stated, *files.values()) or stated["name"] != name:
        raise InputError(
            f"{path}: it, {name}.h or {name}.c is altered, renamed or from another export; export it again"
        )
    signatures = {}
    for key, values in stated["functions"].items():
        arguments, results = (
            tuple(Leaf(leaf, kind, tuple(shape)) for leaf, kind, shape in values[part])
            for part in ("arguments", "results")
        )
        signatures[key] = Signature(arguments, results, Cost(*(values[field] for field in Cost._fields)))
    return stated["precision"], signatures, files
