"""A small C program that calls an export, prints the results and measures the time, and a CMake file for both."""

from collections.abc import Mapping
from math import prod

from dln_jax.export.c.interface import KINDS, Signature
from dln_jax.export.c.text import PRECISIONS, comment

_START = """#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "{name}.h"

/* Uniform in [-1, 1), the same on every machine */
static unsigned long seed_ = 1;

static {real} uniform_(void)
{{
    seed_ = (1103515245UL * seed_ + 12345UL) & 0x7fffffffUL;
    return ({real})seed_ / ({real})0x40000000UL - 1;
}}

int main(int arguments_, char **argument_)
{{
    const long calls_ = arguments_ > 1 ? atol(argument_[1]) : 0;
"""
_TIMED = """        if (calls_ > 0) {{
            const clock_t start_ = clock();
            for (long k_ = 0; k_ < calls_; ++k_) {{ {moved}{call}; }}
            const double seconds_ = (double)(clock() - start_) / CLOCKS_PER_SEC;
            const double each_ = seconds_ / (double)calls_;
            printf("{function}: %.0f calls/s, %.3f us each\\n", 1 / each_, 1e6 * each_);
        }}
"""


def demo(name: str, functions: Mapping[str, Signature], precision: str) -> str:
    """Returns NAME_demo.c, which prints every function at one state and, with an argument N, times N calls.

    Real arguments are random, but a time step `dt` is a millisecond.
    """
    real = PRECISIONS[precision][1]
    kinds = {**KINDS, "real": real}
    text = comment(
        f"{name}_demo.c: prints what the functions of {name}.h give at one state.",
        f"cc -std=c99 -O3 -march=native {name}.c {name}_demo.c -lm -o {name}_demo\n"
        f"./{name}_demo 1000000    also times a million calls of each",
    ) + _START.format(name=name, real=real)
    for key, function in functions.items():
        leaves = [*function.arguments, *function.results]
        names = [leaf.name if leaf.shape else f"{leaf.name}[0]" for leaf in leaves]
        call = f"{name}_{key}({', '.join(names[: len(names) - function.returns])})"
        call = f"{names[-1]} = {call}" if function.returns else call
        text += "    {\n" + "".join(
            f"        static {kinds[leaf.kind]} {leaf.name}[{max(prod(leaf.shape), 1)}];\n" for leaf in leaves
        )
        for leaf in function.arguments:
            value = "uniform_()" if leaf.kind == "real" else "0"
            value = f"({real})1e-3" if leaf.name == "dt" else value  # discrete-time steps have this argument
            text += f"        for (int i_ = 0; i_ < {prod(leaf.shape)}; ++i_) {leaf.name}[i_] = {value};\n"
        text += f"        {call};\n"
        for leaf in function.results:
            text += f'        printf("{key} {leaf.name}:");\n'
            text += (
                f'        for (int i_ = 0; i_ < {prod(leaf.shape)}; ++i_) printf(" %.9g", (double){leaf.name}[i_]);\n'
            )
            text += '        printf("\\n");\n'
        # The state changes between calls, so that the compiler cannot remove any.
        first = next((leaf.name for leaf in function.arguments if leaf.kind == "real"), None)
        moved = f"{first}[0] += ({real})1e-6; " if first else ""
        text += _TIMED.format(moved=moved, call=call, function=f"{name}_{key}") + "    }\n"
    return text + "    return 0;\n}\n"


def cmake(name: str) -> str:
    """Returns CMakeLists.txt, which builds the model as a library, and the demo."""
    return f"""# Builds the model as a library and its demo: cmake -B build && cmake --build build
cmake_minimum_required(VERSION 3.10)
project({name} C)

if(NOT CMAKE_BUILD_TYPE)
  set(CMAKE_BUILD_TYPE Release)
endif()

add_library({name} {name}.c)
target_include_directories({name} PUBLIC ${{CMAKE_CURRENT_SOURCE_DIR}})
set_target_properties({name} PROPERTIES C_STANDARD 99 C_EXTENSIONS OFF POSITION_INDEPENDENT_CODE ON)
if(UNIX)
  target_link_libraries({name} PUBLIC m)
endif()

add_executable({name}_demo {name}_demo.c)
set_target_properties({name}_demo PROPERTIES C_STANDARD 99 C_EXTENSIONS OFF)
target_link_libraries({name}_demo PRIVATE {name})
"""
