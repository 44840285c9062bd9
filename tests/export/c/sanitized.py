"""Exported C in a program of its own, built with the address and undefined-behaviour sanitizers."""

import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from comparison import STRICT, Functions

from dln_jax.export.c.interface import KINDS, Signature, read_interface
from dln_jax.export.c.load import compile_c
from dln_jax.export.c.source import export_c

SANITIZERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
FLAGS = ("-std=c99", "-pedantic", *STRICT, "-g", "-O1", *SANITIZERS)


def in_sanitized_c(
    functions: Functions, states: Mapping[str, list[Any]], folder: Path, **options: Any
) -> dict[str, list[list[Any]]]:
    """Results of each function in each of its states, in double precision; fails at the first sanitizer report.

    Args:
        functions: of arrays by name, each with examples.
        states: of each function, its arguments.
        folder: of the export and the program.
        options: of `export_c`.
    """
    export_c(functions, folder, **options)
    _, signatures, _ = read_interface(folder, "model")
    program = folder / "run"
    (folder / "run.c").write_text(_main(signatures, {name: len(states[name]) for name in functions}))
    compile_c([*FLAGS, str(folder / "model.c"), str(folder / "run.c"), "-lm", "-o", str(program)])
    data = b"".join(
        np.ascontiguousarray(array, _type(leaf.kind)).tobytes()
        for name, signature in signatures.items()
        for state in states[name]
        for leaf, array in zip(signature.arguments, state, strict=True)
    )
    ran = subprocess.run([program], input=data, capture_output=True, timeout=300)
    assert ran.returncode == 0, ran.stderr.decode()[-3000:]
    return _read(ran.stdout, signatures, states)


def _main(signatures: Mapping[str, Signature], counts: Mapping[str, int]) -> str:
    """A program that reads arguments of every state and writes results."""
    text = '#include <stdio.h>\n\n#include "model.h"\n\n'
    text += "static void take(void *to, size_t size, size_t count)\n{\n"
    text += '    if (fread(to, size, count, stdin) != count) perror("arguments");\n}\n\nint main(void)\n{\n'
    for name, signature in signatures.items():
        text += f"    for (int k = 0; k < {counts[name]}; ++k) {{\n"
        for place, leaf in enumerate([*signature.arguments, *signature.results]):
            kind = "double" if leaf.kind == "real" else KINDS[leaf.kind]
            text += f"        {kind} x{place}[{max(int(np.prod(leaf.shape)), 1)}];\n"
        passed = []
        for place, leaf in enumerate(signature.arguments):
            text += f"        take(x{place}, sizeof *x{place}, {int(np.prod(leaf.shape))});\n"
            passed.append(f"x{place}" if leaf.shape else f"*x{place}")
        results = [f"x{len(signature.arguments) + place}" for place in range(len(signature.results))]
        call = f"model_{name}({', '.join([*passed, *([] if signature.returns else results)])})"
        text += f"        *{results[0]} = {call};\n" if signature.returns else f"        {call};\n"
        for result, leaf in zip(results, signature.results, strict=True):
            text += f"        fwrite({result}, sizeof *{result}, {int(np.prod(leaf.shape))}, stdout);\n"
        text += "    }\n"
    return text + "    return 0;\n}\n"


def _read(data: bytes, signatures: Mapping[str, Signature], states: Mapping[str, list[Any]]) -> Any:
    start, every = 0, {}
    for name, signature in signatures.items():
        every[name] = []
        for _ in states[name]:
            results = []
            for leaf in signature.results:
                dtype = np.dtype(_type(leaf.kind))
                size = int(np.prod(leaf.shape)) * dtype.itemsize
                results.append(np.frombuffer(data[start : start + size], dtype).reshape(leaf.shape))
                start += size
            every[name].append(results)
    assert start == len(data)
    return every


def _type(kind: str) -> Any:
    return {"real": np.float64, "bool": np.int32, "int": np.int32, "long": np.int64, "unsigned": np.uint32}.get(
        kind, np.uint64
    )
