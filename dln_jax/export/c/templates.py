"""Texts of the exported files: header, preamble, demo program, CasADi interface and CMake file."""

import re
from collections.abc import Mapping, Sequence
from math import prod

from dln_jax.export.c import elementary, factorisations, kernels, operations
from dln_jax.export.c.body import Source
from dln_jax.export.c.interface import Cost, Signature, declaration
from dln_jax.export.c.text import C_TYPES, PRECISIONS, comment, fill, table

_PROMISES = """Functions of one state. Their workspace is on the stack, so they may run in several threads.
Results may overlap arguments, as updates in place do, but not each other: all arguments are read before results are
written. NaN and infinities in a state propagate to the results."""
NEEDED = """C99; needs <math.h>, <float.h> and <stdint.h>, and nothing else. Fastest with -O3 for the processor at hand
(gcc: -march=native) and -DDLN_OWN_ELEMENTARY, which replaces the C library's exp, tanh, sin and others by functions
that vectorise; does not compile with -ffast-math, which gives wrong numbers."""
_PREAMBLE = """\
#include <float.h>
#include <math.h>
#include <stdint.h>

#include "$name.h"

#if defined __FAST_MATH__ || defined __ASSOCIATIVE_MATH__ || defined _M_FP_FAST || __FINITE_MATH_ONLY__ + 0
#error "NaN, infinities and rounding are relied on: do not use -ffast-math or any of its options"
#endif

typedef $real real;

/* These passes of gcc take as long as all others together and find nothing here */
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("no-gcse", "no-gcse-after-reload")
#endif

/* a b + c, rounded once if the processor has such an operation */
#ifdef FP_FAST_FMA$upper
#define MULTIPLY_ADD(a, b, c) fma${f}(a, b, c)
#else
#define MULTIPLY_ADD(a, b, c) ((a) * (b) + (c))
#endif
#ifdef __cplusplus
#define RESTRICT
#else
#define RESTRICT restrict
#endif

"""
_HEADER = """\
#ifndef $guard
#define $guard

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif
$declared
#ifdef __cplusplus
}
#endif

#endif
"""
CMAKE = """# Builds the model as a library and its demo: cmake -B build && cmake --build build
cmake_minimum_required(VERSION 3.10)
project({name} C)

if(NOT CMAKE_BUILD_TYPE)
  set(CMAKE_BUILD_TYPE Release)
endif()

# Functions that vectorise in place of the C library's exp, tanh, sin and others. They pay with the vector instructions
# of the processor at hand (-DCMAKE_C_FLAGS=-march=native), and are slower than the library's without them.
option(DLN_OWN_ELEMENTARY "Use the model's own exp, tanh, sin and others" OFF)
if(DLN_OWN_ELEMENTARY)
  add_definitions(-DDLN_OWN_ELEMENTARY)
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
"""CMakeLists.txt, which builds the model as a library, and the demo."""
_DEMO = """#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "$name.h"

typedef $real real;

/* Uniform in [-1, 1), the same on every machine */
static unsigned long seed_ = 1;

static real uniform_(void)
{
    seed_ = (1103515245UL * seed_ + 12345UL) & 0x7fffffffUL;
    return (real)seed_ / (real)0x40000000UL - 1;
}

#define FILL_(x, n, value) for (int i_ = 0; i_ < n; ++i_) x[i_] = value
#define PRINT_(name, x, n) \\
    printf(name ":"); \\
    for (int i_ = 0; i_ < n; ++i_) printf(" %.9g", (double)x[i_]); \\
    printf("\\n")
/* Repeated calls, again if the clock has not moved. The state changes between them, so that none can be removed */
#define TIME_(name, change, call) \\
    if (calls_ > 0) { \\
        const clock_t start_ = clock(); \\
        clock_t end_ = start_; \\
        double made_ = 0; \\
        while (end_ == start_) { \\
            for (long k_ = 0; k_ < calls_; ++k_) { change; call; } \\
            made_ += (double)calls_; \\
            end_ = clock(); \\
        } \\
        const double each_ = (double)(end_ - start_) / CLOCKS_PER_SEC / made_; \\
        printf(name ": %.0f calls/s, %.3f us each\\n", 1 / each_, 1e6 * each_); \\
    }

int main(int arguments_, char **argument_)
{
    const long calls_ = arguments_ > 1 ? atol(argument_[1]) : 0;
$blocks    return 0;
}
"""


def demo(name: str, functions: Mapping[str, Signature], precision: str) -> str:
    """Returns NAME_demo.c, which prints every function at one state and, with an argument N, times N calls.

    Real arguments are random, except that a time step `dt` is a millisecond.
    """
    blocks = ""
    for key, function in functions.items():
        leaves = [*function.arguments, *function.results]
        names = [leaf.name if leaf.shape else f"{leaf.name}[0]" for leaf in leaves]
        call = f"{name}_{key}({', '.join(names[: len(names) - function.returns])})"
        call = f"{names[-1]} = {call}" if function.returns else call
        lines = [f"static {C_TYPES[leaf.kind]} {leaf.name}[{max(prod(leaf.shape), 1)}];" for leaf in leaves]
        change = "(void)0"
        for leaf in reversed(function.arguments):
            value = "0"
            if leaf.kind == "real":
                change = f"{leaf.name}[0] += (real)1e-6"
                value = "(real)1e-3" if leaf.name == "dt" else "uniform_()"  # discrete-time steps have this argument
            lines.append(f"FILL_({leaf.name}, {prod(leaf.shape)}, {value});")
        lines.append(f"{call};")
        lines += [f'PRINT_("{key} {leaf.name}", {leaf.name}, {prod(leaf.shape)});' for leaf in function.results]
        lines.append(f'TIME_("{name}_{key}", {change}, {call})')
        blocks += "    {\n" + "".join(f"        {line}\n" for line in lines) + "    }\n"
    return comment(
        f"{name}_demo.c: prints the results of the functions of {name}.h at one state.",
        f"cc -std=c99 -O3 -march=native -DDLN_OWN_ELEMENTARY {name}.c {name}_demo.c -lm -o {name}_demo\n"
        f"./{name}_demo 1000000    also times a million calls of each",
    ) + fill(_DEMO, precision, name=name, blocks=blocks)


def preamble(source: Source, name: str, text: str) -> str:
    """Returns the part of a source before the text of its functions, with the helper functions that they call."""
    precision = source.precision
    called = set(re.findall(r"\belementary_(\w+)\(", text))
    on_matrices = re.findall(r"\b(?:elementary_)?(\w+)\(", text)
    if called & {"word_of", "number_of"}:
        called.add("choice")
    arrays = {function.removesuffix("_each") for function in called if function.endswith("_each")}
    tables = "".join(f"{table(*named, precision)}\n" for named in source.tables.values())
    return "".join((
        fill(_PREAMBLE, precision, name=name, upper=source.suffix.upper()),
        tables.removesuffix("\n"),
        elementary.definitions(called, precision, arrays=arrays),
        operations.definitions(called, precision),
        *(kernels.ORDER.substitute(kind=kind, c=c) for kind, c in C_TYPES.items() if f"order_{kind}" in called),
        factorisations.definitions(on_matrices, source.suffix),
    ))  # fmt: skip


def header(
    name: str, written_by: str, signatures: Mapping[str, Signature], precision: str, left_out: Sequence[str]
) -> str:
    """Returns the header: the prototype of every function, the shapes of its results and its cost."""
    declared = ""
    for key, signature in signatures.items():
        results = ", ".join(leaf.described for leaf in signature.results)
        prototype = declaration(name, key, signature, PRECISIONS[precision][1])
        declared += f"\n/* {results}; {stated(signature.cost)} */\n{prototype};\n"
    text = comment(f"{name}.h", written_by, _PROMISES, *left_out)
    return text + fill(_HEADER, precision, guard=f"{name.upper()}_H", declared=declared)


def stated(cost: Cost) -> str:
    """Returns the cost of a call in words."""
    names = ("additions", "multiplications", "divisions", "square_roots", "functions")
    kinds = [f"{name.replace('_', ' ')} {getattr(cost, name)}" for name in names if getattr(cost, name)]
    kinds += [f"unbounded loops, with one iteration counted {cost.unbounded_loops}"] * bool(cost.unbounded_loops)
    text = f"at most {cost.operations} floating-point operations, {cost.stack_bytes} bytes of stack"
    return text + f"\n   ({', '.join(kinds)})" * bool(kinds)
