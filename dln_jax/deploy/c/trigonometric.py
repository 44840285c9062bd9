"""Trigonometric Lagrangian as C: the closed forms of `models.trigonometric`."""

from string import Template
from typing import Any

import numpy as np

from dln_jax.deploy.c.interface import definitions
from dln_jax.deploy.c.text import friction_table, table
from dln_jax.models.trigonometric import potential_degrees
from dln_jax.types import Needs

_MOTION = """
/* Symmetric M from its lower triangle, row by row, both row-major */
static void unpack(const real *restrict triangle, real *restrict M)
{
    int n = 0;
    for (int i = 0; i < D; ++i)
        for (int j = 0; j <= i; ++j, ++n) {
            M[i * D + j] = triangle[n];
            M[j * D + i] = triangle[n];
        }
}

/* M, and the force that a motion without acceleration takes: dM/dt qd - d(qd^T M qd / 2)/dq + dV/dq and friction. */
static void motion(const real *restrict q, const real *restrict qd, real *restrict M, real *restrict bias)
{
    real b[BASIS], slopes[D * BASIS], b_rate[BASIS], kinetic[BASIS];
    real triangle[ENTRIES], products[ENTRIES], M_rate[D * D], force[D];
    int n = 0;
    mass_basis(q, b, slopes);
    dots_${entries}_${basis}(mass, b, triangle);
    unpack(triangle, M);
    push_${d}_${basis}(slopes, qd, b_rate);
    dots_${entries}_${basis}(mass, b_rate, triangle);
    unpack(triangle, M_rate);
    for (int i = 0; i < D; ++i)
        for (int j = 0; j <= i; ++j) products[n++] = (i == j ? ${half} : 1) * qd[i] * qd[j];
    push_${entries}_${basis}(mass, products, kinetic);
    dots_${d}_${basis}(slopes, kinetic, force);
    dots_${d}_${d}(M_rate, qd, bias);
    for (int i = 0; i < D; ++i) bias[i] -= force[i];
${gravity}}
"""
_BODIES = {
    "inverse_dynamics": """\
    real M[D * D], bias[D];
    motion(q, qd, M, bias);
    dots_${d}_${d}(M, qdd, tau);
    for (int i = 0; i < D; ++i) tau[i] += bias[i];
""",
    "forward_dynamics": """\
    real M[D * D], bias[D];
    motion(q, qd, M, bias);
    for (int i = 0; i < D; ++i) qdd[i] = tau[i] - bias[i];
    eliminate_1(M, qdd);
""",
    "energy": """\
    real M[D * D], momentum[D], energy = 0;
    ${name}_mass_matrix(q, M);
    dots_${d}_${d}(M, qd, momentum);
    for (int i = 0; i < D; ++i) energy += momentum[i] * qd[i];
    energy /= 2;
${potential}    return energy;
""",
    "mass_matrix": """\
    real b[BASIS], slopes[D * BASIS], triangle[ENTRIES];
    mass_basis(q, b, slopes);
    dots_${entries}_${basis}(mass, b, triangle);
    unpack(triangle, M);
""",
}


def source(description: dict[str, Any], parameters: Any, needs: Needs, precision: str) -> str:
    """Body of the C source, with `$name` and `${f}` left to fill in."""
    d, degree = needs.degrees_of_freedom, description["degree"]
    degrees = (degree,) * d if isinstance(degree, int) else tuple(degree)
    entries, size = parameters.mass.shape
    head = f"enum {{ D = {d}, ENTRIES = {entries}, BASIS = {size} }};\n"
    head += "\n/* Coefficients of M: its lower triangle row by row, times the basis */\n"
    head += table("mass", np.asarray(parameters.mass).ravel(), precision)
    functions = _basis("mass_basis", needs, degrees)
    gravity = energy = ""
    if parameters.potential is not None:
        # The constant, which no motion shows, is not stored.
        coefficients = np.concatenate([[0.0], np.asarray(parameters.potential)])
        head += "\n/* Coefficients of V, J */\n" + table("potential", coefficients, precision)
        count = len(coefficients)
        own_degrees = potential_degrees(needs.joints, degrees)
        declared = f"    real terms[{count}], term_slopes[D * {count}];\n"
        basis, slopes = "mass_basis", "slopes"
        if own_degrees != degrees:
            basis, slopes = "potential_basis", "term_slopes"
            functions += _basis(basis, needs, own_degrees)
            gravity = f"{declared}    {basis}(q, terms, term_slopes);\n"
        gravity += f"    dots_{d}_{count}({slopes}, potential, force);\n"
        gravity += "    for (int i = 0; i < D; ++i) bias[i] += force[i];\n"
        energy = f"{declared}    {basis}(q, terms, term_slopes);\n"
        energy += f"    for (int l = 0; l < {count}; ++l) energy += potential[l] * terms[l];\n"
    if parameters.friction is not None:
        gravity += "    for (int i = 0; i < D; ++i) bias[i] += friction[i] * qd[i];\n"
    body = Template(_MOTION + definitions("trigonometric", _BODIES)).safe_substitute(
        d=d, entries=entries, basis=size, half="0.5${f}", gravity=gravity, potential=energy
    )
    return head + friction_table(parameters.friction, precision) + functions + body


def _basis(name: str, needs: Needs, degrees: tuple[int, ...]) -> str:
    """`NAME(q, b, slopes)`: products over joints of the functions of each, and their partial derivatives."""
    joints = range(needs.degrees_of_freedom)
    lines, loops, size = "", "", 1
    for joint, (kind, n) in enumerate(zip(needs.joints, degrees, strict=True)):
        orders = range(1, n + 1)
        if kind == "revolute":
            values = [f"{function}${{f}}({k} * q[{joint}])" for function in ("cos", "sin") for k in orders]
            rates = [f"-{k} * v_{joint}[{n + k}]" for k in orders] + [f"{k} * v_{joint}[{k}]" for k in orders]
        else:
            values = [" * ".join([f"q[{joint}]"] * k) for k in orders]
            rates = [f"{k} * v_{joint}[{k - 1}]" for k in orders]
        count = 1 + len(values)
        size *= count
        lines += f"    const real v_{joint}[{count}] = {{{', '.join(['1', *values])}}};\n"
        lines += f"    const real s_{joint}[{count}] = {{{', '.join(['0', *rates])}}};\n"
        loops += f"\n    for (int k_{joint} = 0; k_{joint} < {count}; ++k_{joint})"
    lines += f"    int l = 0;{loops} {{\n"
    lines += f"        b[l] = {' * '.join(f'v_{joint}[k_{joint}]' for joint in joints)};\n"
    for row in joints:
        factors = " * ".join(f"{'s' if joint == row else 'v'}_{joint}[k_{joint}]" for joint in joints)
        lines += f"        slopes[{row} * {size} + l] = {factors};\n"
    return (
        "\n/* Basis functions at q [.], and their partial derivatives [D, .] */\n"
        f"static void {name}(const real *restrict q, real *restrict b, real *restrict slopes)\n"
        f"{{\n{lines}        ++l;\n    }}\n}}\n"
    )
