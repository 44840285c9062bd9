"""Times of single functions of exported C, measured in C: loops of warm calls, and calls after emptying the caches.

Calls of a control loop are cold: they come once a millisecond, and other code has used the caches in between. The
timing program `time_calls.c.in` is completed from the header of an export, so that it fits any exporter: declarations
are `void NAME_function(const real q[2], real dt, real tau[2]);`, and a function may return a number as its result.
"""

import json
import math
import re
import subprocess
from collections.abc import Iterable
from pathlib import Path
from string import Template
from typing import NamedTuple

import numpy as np

from dln_jax.export.c.load import FLAGS, STANDARD, compile_c
from dln_jax.types import InputError

SMALLEST, LARGEST = 8, 64
"""Bounds on the memory that is read to empty the caches, MiB; within them it is twice the last-level cache."""

_PROGRAM = Path(__file__).with_name("time_calls.c.in").read_text()
_PROTOTYPE = r"^(void|double|float)\s+{name}_(\w+)\(([^)]*)\);"
_ARGUMENT = re.compile(r"\s*(const\s+)?(double|float)\s+(\w+)(?:\[([\d* ]+)\])?\s*")


class Prototype(NamedTuple):
    """A declared function: its C type of numbers, and names and sizes of its arguments."""

    real: str
    inputs: dict[str, int]
    """Sizes of the inputs by name; 0 for a number passed by value."""
    results: dict[str, int]
    returns: bool
    """Whether the function returns a number."""


class Times(NamedTuple):
    """Nanoseconds of calls of one function in one process."""

    hot: np.ndarray
    """Mean times of a call in a loop, one per repeat."""
    cold: np.ndarray
    """Times of single calls, without the clock's own time."""
    timer: float
    """The clock's own time."""
    sum: float
    """Sum of the magnitudes of all results, for comparing exports of one model; NaN if not finite."""
    compiler: str
    """Name and version of the compiler."""


def prototypes(header: str, name: str) -> dict[str, Prototype]:
    """The functions NAME_... declared in a header with numbers of one type, by their names without NAME_."""
    declared = {}
    for returned, function, text in re.findall(_PROTOTYPE.format(name=re.escape(name)), header, re.MULTILINE):
        arguments = [match for argument in text.split(",") if (match := _ARGUMENT.fullmatch(argument))]
        reals = {match[2] for match in arguments} | {returned} - {"void"}
        if len(arguments) <= text.count(",") or len(reals) != 1:
            continue
        sizes = {match[3]: math.prod(map(int, match[4].split("*"))) if match[4] else 0 for match in arguments}
        written = {match[3] for match in arguments if match[4] and not match[1]}
        inputs = {key: size for key, size in sizes.items() if key not in written}
        results = {key: sizes[key] for key in sizes if key in written}
        declared[function] = Prototype(reals.pop(), inputs, results, returned != "void")
    return declared


def program(name: str, function: str, prototype: Prototype) -> str:
    """C source of a program that times one function; it takes REPEATS CALLS COLD BYTES and prints JSON, in ns."""
    inputs, results, arguments = 0, 0, []
    for size in prototype.inputs.values():
        arguments.append(f"&x[{inputs}]" if size else f"x[{inputs}]")
        inputs += size or 1
    for size in prototype.results.values():
        arguments.append(f"&y[{results}]")
        results += size
    call = f"{f'y[{results}] = ' * prototype.returns}{name}_{function}({', '.join(arguments)})"
    sizes = {"inputs": inputs, "results": results + prototype.returns}
    return Template(_PROGRAM).substitute(sizes, name=name, real=prototype.real, call=call)


def compiled(export: Path, place: Path, *, name: str = "model") -> Path:
    """Compiles an export's source to an object file as `load_c` does; `InputError` if that fails."""
    built = place / f"{name}.o"
    compile_c([*STANDARD, *FLAGS, "-c", str(export / f"{name}.c"), "-o", str(built)])
    return built


def programs(export: Path, model: Path, functions: Iterable[str], *, name: str = "model") -> dict[str, Path]:
    """Builds timing programs for the functions that an export declares, beside the object file `model` of its source.

    Raises:
        InputError: the export declares none of the functions, or the header does not compile.
    """
    declared, built = prototypes((export / f"{name}.h").read_text(), name), {}
    for function in functions:
        if function in declared:
            source = model.with_name(f"time_{function}.c")
            source.write_text(program(name, function, declared[function]))
            built[function] = source.with_suffix("")
            # Compiled separately from the model, so that no call is inlined into the loop.
            compile_c([*STANDARD, *FLAGS, f"-I{export}", str(source), str(model), "-lm", "-o", str(built[function])])
    if not built:
        raise InputError(f"{export / f'{name}.h'} declares none of {', '.join(functions)}; export it again")
    return built


def timed(program: Path, *, repeats: int, calls: int, cold: int, mebibytes: int) -> Times:
    """Runs a program that `programs` built.

    Args:
        program: program of one function.
        repeats: number of loops of warm calls.
        calls: number of calls per loop.
        cold: number of single calls with emptied caches.
        mebibytes: memory that is read to empty the caches.

    Raises:
        InputError: the program ends with an error.
    """
    command = [program, *map(str, (repeats, calls, cold, mebibytes << 20))]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise InputError(f"{program.name} ended with status {done.returncode}; does the model's demo run?")
    answer = json.loads(done.stdout)
    hot, cold_calls = (np.asarray(answer[key], float) for key in ("hot_ns", "cold_ns"))
    total = math.nan if answer["sum"] is None else answer["sum"]
    return Times(hot, cold_calls, answer["timer_ns"], total, answer["compiler"])


def last_level_cache() -> int | None:
    """Size of the processor's largest cache, MiB; `None` if the system does not report it (other than Linux)."""
    units = {"K": 2**10, "M": 2**20}
    sizes = [path.read_text().strip() for path in Path("/sys/devices/system/cpu/cpu0/cache").glob("index*/size")]
    return max((int(size[:-1]) * units[size[-1]] >> 20 for size in sizes if size[-1:] in units), default=None)


def evicting() -> int:
    """Memory to read to empty the caches, MiB."""
    return min(max(2 * (last_level_cache() or LARGEST), SMALLEST), LARGEST)
