"""A small C program that calls an exported model, checks it and times it; and a CMake file that builds both."""

from dln_jax.deploy.c.text import PRECISIONS, comment

_RANDOM = """
/* Uniform in [-1, 1), the same on every machine */
static unsigned long seed = 1;

static {real} uniform(void)
{{
    seed = (1103515245UL * seed + 12345UL) & 0x7fffffffUL;
    return ({real})seed / ({real})0x40000000UL - 1;
}}
"""
_MAIN = """
int main(int arguments, char **argument)
{{
    const long calls = arguments > 1 ? atol(argument[1]) : 0;
{declarations}
    for (int k = 0; k < STATES; ++k)
        for (int i = 0; i < {per_state}; ++i) states[k][i] = uniform();
{show}
    if (calls > 0) {{
        double sum = 0, seconds;
        const clock_t start = clock();
        for (long call = 0; call < calls; ++call) {{
            const {real} *state = states[call % STATES];
{timed}
        }}
        seconds = (double)(clock() - start) / CLOCKS_PER_SEC;
        printf("{function}: %.0f calls/s, %.3f us each (sum %g)\\n", (double)calls / seconds,
               1e6 * seconds / (double)calls, sum);
    }}
    return 0;
}}
"""


def demo(name: str, functions: dict[str, tuple[str, str]], sizes: dict[str, int], precision: str) -> str:
    """Text of NAME_demo.c: prints each function at one state, and with an argument N times N calls of the first.

    `functions` are (result, arguments) as in the header.
    """
    real = PRECISIONS[precision][1]
    about = comment(
        f"{name}_demo.c: prints what the functions of {name}.h give at one state.",
        f"cc -std=c99 -O3 -march=native {name}.c {name}_demo.c -lm -o {name}_demo\n"
        f"./{name}_demo 1000000    also times a million calls of the first function",
    )
    head = f'{about}#include <stdio.h>\n#include <stdlib.h>\n#include <time.h>\n\n#include "{name}.h"\n\n'
    head += "enum { STATES = 64 };\n"
    head += _RANDOM.format(real=real)
    head += _print_function(real)
    values = _dynamics(name, functions, sizes["d"], real) if "d" in sizes else _function(name, sizes, real)
    return head + _MAIN.format(real=real, function=f"{name}_{next(iter(functions))}", **values)


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


def _print_function(real: str) -> str:
    return f"""
static void print(const char *what, const {real} *values, int count)
{{
    printf("%s:", what);
    for (int i = 0; i < count; ++i) printf(" %.9g", (double)values[i]);
    printf("\\n");
}}
"""


def _dynamics(name: str, functions: dict[str, tuple[str, str]], d: int, real: str) -> dict[str, str]:
    declarations = f"    static {real} states[STATES][{3 * d}];\n    {real} tau[{d}], qdd[{d}];"
    q, qd, qdd = "states[0]", f"&states[0][{d}]", f"&states[0][{2 * d}]"
    show = [
        f'print("q", {q}, {d});',
        f'print("qd", {qd}, {d});',
        f'print("qdd", {qdd}, {d});',
        f"{name}_inverse_dynamics({q}, {qd}, {qdd}, tau);",
        f'print("tau", tau, {d});',
        f"{name}_forward_dynamics({q}, {qd}, tau, qdd);",
        f'print("qdd from tau", qdd, {d});',
    ]
    if "energy" in functions:
        velocity = f"{qd}, " if " qd[" in functions["mass_matrix"][1] else ""
        declarations += f"\n    {real} energy, M[{d * d}];"
        show += [
            f"energy = {name}_energy({q}, {qd});",
            'print("energy", &energy, 1);',
            f"{name}_mass_matrix({q}, {velocity}M);",
            f'print("mass matrix", M, {d * d});',
        ]
    timed = [f"{name}_inverse_dynamics(state, state + {d}, state + {2 * d}, tau);", "sum += (double)tau[0];"]
    return _texts(declarations, show, timed, 3 * d)


def _function(name: str, sizes: dict[str, int], real: str) -> dict[str, str]:
    n, m = sizes["n"], sizes["m"]
    declarations = f"    static {real} states[STATES][{n}];\n    {real} y[{m}], jacobian[{m * n}];"
    show = [
        f'print("x", states[0], {n});',
        f"{name}_value(states[0], y);",
        f'print("y", y, {m});',
        f"{name}_value_and_jacobian(states[0], y, jacobian);",
        f'print("dy/dx", jacobian, {m * n});',
    ]
    return _texts(declarations, show, [f"{name}_value(state, y);", "sum += (double)y[0];"], n)


def _texts(declarations: str, show: list[str], timed: list[str], per_state: int) -> dict[str, str]:
    return {
        "declarations": declarations,
        "per_state": str(per_state),
        "show": "".join(f"    {line}\n" for line in show).rstrip("\n"),
        "timed": "".join(f"            {line}\n" for line in timed).rstrip("\n"),
    }
