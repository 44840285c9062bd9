"""Trigonometric Lagrangian as C: the closed forms of `models.trigonometric`."""

from string import Template
from typing import Any

import numpy as np

from dln_jax.deploy.c.text import friction_table, table
from dln_jax.models.trigonometric import SPRING_DEGREE
from dln_jax.types import Needs

_BODY = """
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

void ${name}_inverse_dynamics(const real q[D], const real qd[D], const real qdd[D], real tau[D])
{
    real M[D * D], bias[D];
    motion(q, qd, M, bias);
    dots_${d}_${d}(M, qdd, tau);
    for (int i = 0; i < D; ++i) tau[i] += bias[i];
}

void ${name}_forward_dynamics(const real q[D], const real qd[D], const real tau[D], real qdd[D])
{
    real M[D * D], bias[D];
    motion(q, qd, M, bias);
    for (int i = 0; i < D; ++i) qdd[i] = tau[i] - bias[i];
    eliminate_1(M, qdd);
}

real ${name}_energy(const real q[D], const real qd[D])
{
    real M[D * D], momentum[D], energy = 0;
    ${name}_mass_matrix(q, M);
    dots_${d}_${d}(M, qd, momentum);
    for (int i = 0; i < D; ++i) energy += momentum[i] * qd[i];
    energy /= 2;
${potential}    return energy;
}

void ${name}_mass_matrix(const real q[D], real M[D * D])
{
    real b[BASIS], slopes[D * BASIS], triangle[ENTRIES];
    mass_basis(q, b, slopes);
    dots_${entries}_${basis}(mass, b, triangle);
    unpack(triangle, M);
}
"""


def source(description: dict[str, Any], parameters: Any, needs: Needs, precision: str) -> str:
    """Body of the C source, with `$name` and `${f}` left to fill in."""
    d = needs.degrees_of_freedom
    degree = description["degree"]
    degrees = (degree,) * d if isinstance(degree, int) else tuple(degree)
    potential_degrees = tuple(
        max(n, SPRING_DEGREE) if joint == "prismatic" else n for joint, n in zip(needs.joints, degrees, strict=True)
    )
    entries, size = parameters.mass.shape
    potential = parameters.potential
    head = [
        f"enum {{ D = {d}, ENTRIES = {entries}, BASIS = {size} }};\n",
        "\n/* Coefficients of M: its lower triangle row by row, times the basis */\n",
        table("mass", np.asarray(parameters.mass).ravel(), precision),
    ]
    if potential is not None:
        # The constant, which no motion shows, is not stored.
        head += [
            "\n/* Coefficients of V, J */\n",
            table("potential", np.concatenate([[0.0], np.asarray(potential)]), precision),
        ]
    head.append(friction_table(parameters.friction, precision))
    functions = [_basis("mass_basis", needs, degrees)]
    gravity, energy = [], []
    if potential is not None:
        count = len(potential) + 1
        if potential_degrees == degrees:
            gravity = [f"    dots_{d}_{size}(slopes, potential, force);\n"]
            basis = "mass_basis"
        else:
            basis = "potential_basis"
            functions.append(_basis(basis, needs, potential_degrees))
            gravity = [
                f"    real terms[{count}], term_slopes[D * {count}];\n",
                "    potential_basis(q, terms, term_slopes);\n",
                f"    dots_{d}_{count}(term_slopes, potential, force);\n",
            ]
        gravity.append("    for (int i = 0; i < D; ++i) bias[i] += force[i];\n")
        energy = [
            f"    real terms[{count}], term_slopes[D * {count}];\n",
            f"    {basis}(q, terms, term_slopes);\n",
            f"    for (int l = 0; l < {count}; ++l) energy += potential[l] * terms[l];\n",
        ]
    if parameters.friction is not None:
        gravity.append("    for (int i = 0; i < D; ++i) bias[i] += friction[i] * qd[i];\n")
    texts = {"d": d, "entries": entries, "basis": size, "half": "0.5${f}"}
    texts |= {"gravity": "".join(gravity), "potential": "".join(energy)}
    return "".join([*head, *functions, Template(_BODY).safe_substitute(texts)])


def _basis(name: str, needs: Needs, degrees: tuple[int, ...]) -> str:
    """`NAME(q, b, slopes)`: products over joints of the functions of each, and their partial derivatives."""
    d = needs.degrees_of_freedom
    sizes = [2 * n + 1 if joint == "revolute" else n + 1 for joint, n in zip(needs.joints, degrees, strict=True)]
    lines = []
    for joint, (kind, n, size) in enumerate(zip(needs.joints, degrees, sizes, strict=True)):
        values, rates = ["1"], ["0"]
        if kind == "revolute":
            cosines = [f"cos${{f}}({k} * q[{joint}])" for k in range(1, n + 1)]
            sines = [f"sin${{f}}({k} * q[{joint}])" for k in range(1, n + 1)]
            values += cosines + sines
            rates += [f"-{k} * v_{joint}[{n + k}]" for k in range(1, n + 1)]
            rates += [f"{k} * v_{joint}[{k}]" for k in range(1, n + 1)]
        else:
            values += [" * ".join([f"q[{joint}]"] * k) for k in range(1, n + 1)]
            rates += [f"{k} * v_{joint}[{k - 1}]" for k in range(1, n + 1)]
        lines.append(f"    const real v_{joint}[{size}] = {{{', '.join(values)}}};\n")
        lines.append(f"    const real s_{joint}[{size}] = {{{', '.join(rates)}}};\n")
    lines.append("    int l = 0;\n")
    for joint, size in enumerate(sizes):
        lines.append(f"    for (int k_{joint} = 0; k_{joint} < {size}; ++k_{joint})\n")
    lines[-1] = lines[-1].rstrip("\n") + " {\n"
    lines.append(f"        b[l] = {' * '.join(f'v_{joint}[k_{joint}]' for joint in range(d))};\n")
    for row in range(d):
        factors = " * ".join(f"{'s' if joint == row else 'v'}_{joint}[k_{joint}]" for joint in range(d))
        lines.append(f"        slopes[{row} * {int(np.prod(sizes))} + l] = {factors};\n")
    lines += ["        ++l;\n", "    }\n"]
    return (
        "\n/* Basis functions at q [.], and their partial derivatives [D, .] */\n"
        f"static void {name}(const real *restrict q, real *restrict b, real *restrict slopes)\n{{\n{''.join(lines)}}}\n"
    )
