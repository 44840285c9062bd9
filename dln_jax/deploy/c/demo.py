"""A small C program that calls an exported model, checks it and times it; and a CMake file that builds both."""

from string import Template

from dln_jax.deploy.c.text import PRECISIONS, comment

_PROGRAM = """#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "$name.h"

enum { STATES = 64 };

/* Uniform in [-1, 1), the same on every machine */
static unsigned long seed = 1;

static $real uniform(void)
{
    seed = (1103515245UL * seed + 12345UL) & 0x7fffffffUL;
    return ($real)seed / ($real)0x40000000UL - 1;
}

static void print(const char *what, const $real *values, int count)
{
    printf("%s:", what);
    for (int i = 0; i < count; ++i) printf(" %.9g", (double)values[i]);
    printf("\\n");
}

int main(int arguments, char **argument)
{
    const long calls = arguments > 1 ? atol(argument[1]) : 0;
    static $real states[STATES][$per_state];
$declarations
    for (int k = 0; k < STATES; ++k)
        for (int i = 0; i < $per_state; ++i) states[k][i] = uniform();
$show
    if (calls > 0) {
        double sum = 0, seconds;
        const clock_t start = clock();
        for (long call = 0; call < calls; ++call) {
            const $real *state = states[call % STATES];
            ${name}_$timed;
            sum += (double)$summed[0];
        }
        seconds = (double)(clock() - start) / CLOCKS_PER_SEC;
        printf("${name}_$function: %.0f calls/s, %.3f us each (sum %g)\\n", (double)calls / seconds,
               1e6 * seconds / (double)calls, sum);
    }
    return 0;
}
"""
_MOTION = """\
    print("q", states[0], $d);
    print("qd", &states[0][$d], $d);
    print("qdd", &states[0][$twice], $d);
    ${name}_inverse_dynamics(states[0], &states[0][$d], &states[0][$twice], tau);
    print("tau", tau, $d);
    ${name}_forward_dynamics(states[0], &states[0][$d], tau, qdd);
    print("qdd from tau", qdd, $d);"""
_ENERGY = """
    energy = ${name}_energy(states[0], &states[0][$d]);
    print("energy", &energy, 1);
    ${name}_mass_matrix(states[0], ${velocity}M);
    print("mass matrix", M, $square);"""
_FUNCTION = """\
    print("x", states[0], $n);
    ${name}_value(states[0], y);
    print("y", y, $m);
    ${name}_value_and_jacobian(states[0], y, jacobian);
    print("dy/dx", jacobian, $square);"""


def demo(name: str, functions: dict[str, list[str]], sizes: dict[str, int], precision: str) -> str:
    """Text of NAME_demo.c: prints each function at one state, and with an argument N times N calls of the first.

    `functions` are (result, arguments) as in the header.
    """
    real = PRECISIONS[precision][1]
    about = comment(
        f"{name}_demo.c: prints what the functions of {name}.h give at one state.",
        f"cc -std=c99 -O3 -march=native {name}.c {name}_demo.c -lm -o {name}_demo\n"
        f"./{name}_demo 1000000    also times a million calls of the first function",
    )
    if "d" in sizes:
        d = sizes["d"]
        per_state, square, summed = 3 * d, d * d, "tau"
        timed = f"inverse_dynamics(state, state + {d}, state + {2 * d}, tau)"
        declarations, show = f"    {real} tau[{d}], qdd[{d}];", _MOTION
        velocity = f"&states[0][{d}], " if " qd[" in functions.get("mass_matrix", ("", ""))[1] else ""
        if "energy" in functions:
            declarations += f"\n    {real} energy, M[{square}];"
            show += _ENERGY
        values = {"d": d, "twice": 2 * d, "velocity": velocity}
    else:
        n, m = sizes["n"], sizes["m"]
        per_state, square, summed, timed = n, m * n, "y", "value(state, y)"
        declarations, show, values = f"    {real} y[{m}], jacobian[{square}];", _FUNCTION, sizes
    return about + Template(_PROGRAM).substitute(
        name=name,
        real=real,
        per_state=per_state,
        declarations=declarations,
        show=Template(show).substitute(values, name=name, square=square),
        timed=timed,
        summed=summed,
        function=next(iter(functions)),
    )


def cmake(name: str) -> str:
    """Text of CMakeLists.txt: the model as a library, and the demo."""
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
