"""Exported C in a program of its own, built with the address and undefined-behaviour sanitizers."""

import io
import subprocess
from math import prod

import numpy as np
from comparison import STRICT

from dln_jax.export.c.interface import read_interface
from dln_jax.export.c.load import compile_c
from dln_jax.export.c.source import export_c
from dln_jax.export.c.text import C_TYPES, NUMPY_TYPES

SANITIZERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
FLAGS = ("-std=c99", "-pedantic", *STRICT, "-g", "-O1", "-DDLN_OWN_ELEMENTARY", *SANITIZERS)


def in_sanitized_c(functions, states, folder, **options):
    """Results of each function in each of its states, in double precision; fails at the first sanitizer report.

    Args:
        functions: of arrays by name, each with examples.
        states: of each function, its arguments.
        folder: of the export and the program.
        options: of `export_c`.
    """
    export_c(functions, folder, **options)
    _, signatures, _ = read_interface(folder, "model")
    calls = "".join(_calls(name, signature, len(states[name])) for name, signature in signatures.items())
    (folder / "run.c").write_text(f"{START}{calls}    return 0;\n}}\n")
    compile_c([*FLAGS, str(folder / "model.c"), str(folder / "run.c"), "-lm", "-o", str(folder / "run")])
    data = b"".join(
        np.ascontiguousarray(array, TYPES[leaf.kind]).tobytes()
        for name, signature in signatures.items()
        for state in states[name]
        for leaf, array in zip(signature.arguments, state, strict=True)
    )
    ran = subprocess.run([folder / "run"], input=data, capture_output=True, timeout=300)
    assert ran.returncode == 0, ran.stderr.decode()[-3000:]
    written = io.BytesIO(ran.stdout)

    def read(leaf):
        dtype = np.dtype(TYPES[leaf.kind])
        return np.frombuffer(written.read(prod(leaf.shape) * dtype.itemsize), dtype).reshape(leaf.shape)

    results = {name: [[*map(read, s.results)] for _ in states[name]] for name, s in signatures.items()}
    assert not written.read()
    return results


TYPES = {**NUMPY_TYPES, "real": np.float64, "bool": np.int32}
START = """\
#include <stdio.h>

#include "model.h"

static void take(void *to, size_t size, size_t count)
{
    if (fread(to, size, count, stdin) != count) perror("arguments");
}

int main(void)
{
"""


def _calls(name, signature, count):
    """C that reads the arguments of every state and writes results."""
    text = f"    for (int k = 0; k < {count}; ++k) {{\n"
    passed = []
    for place, leaf in enumerate([*signature.arguments, *signature.results]):
        text += f"        {C_TYPES[leaf.kind].replace('real', 'double')} x{place}[{max(prod(leaf.shape), 1)}];\n"
        if place < len(signature.arguments):
            text += f"        take(x{place}, sizeof *x{place}, {prod(leaf.shape)});\n"
            passed.append(f"x{place}" if leaf.shape else f"*x{place}")
    results = [f"x{len(passed) + k}" for k in range(len(signature.results))]
    returned = f"*{results[0]} = " if signature.returns else ""
    text += f"        {returned}model_{name}({', '.join([*passed, *([] if returned else results)])});\n"
    for result, leaf in zip(results, signature.results, strict=True):
        text += f"        fwrite({result}, sizeof *{result}, {prod(leaf.shape)}, stdout);\n"
    return text + "    }\n"
