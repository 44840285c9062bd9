"""Structured DeLaN and structured Hamiltonian as C: `mechanics.natural` and `mechanics.natural_hamiltonian`.

One derivative of the triangular factor along the motion and one pull-back, whose covector also takes in the gradient of
the potential, so that one pass back through the features serves both: it gives -dT/dq + dV/dq (or +dT/dq where M⁻¹ is
given) as `force`.
"""

from string import Template
from typing import Any

from dln_jax.deploy.c import networks as c_networks
from dln_jax.deploy.c.interface import definitions
from dln_jax.deploy.c.text import friction_table, number
from dln_jax.types import Needs
from dln_jax.zoo.catalogue import CATALOGUE

_FACTOR = """
/* Triangular factor L (row-major) from the outputs of the network: the diagonal, then what is below it by rows. */
static void unpack_factor(const real *restrict entries, real *restrict L)
{
    int n = D;
    for (int i = 0; i < D; ++i) {
        L[i * D + i] = softplus(entries[i] + DIAGONAL_SHIFT) + DIAGONAL_FLOOR;
        for (int j = 0; j < i; ++j) L[i * D + j] = entries[n++];
        for (int j = i + 1; j < D; ++j) L[i * D + j] = 0;
    }
}

/* L, its rate from the rate of the outputs, and the slope of its diagonal with respect to them. */
static void unpack_factor_rate(const real *restrict entries, const real *restrict entries_rate,
                               real *restrict L, real *restrict L_rate, real *restrict diagonal_slope)
{
    int n = D;
    unpack_factor(entries, L);
    for (int i = 0; i < D; ++i) {
        diagonal_slope[i] = logistic(entries[i] + DIAGONAL_SHIFT);
        L_rate[i * D + i] = diagonal_slope[i] * entries_rate[i];
        for (int j = 0; j < i; ++j) L_rate[i * D + j] = entries_rate[n++];
        for (int j = i + 1; j < D; ++j) L_rate[i * D + j] = 0;
    }
}

/* Covector of the outputs: minus u_i v_j for each element of L. */
static void pack_covector(const real *restrict diagonal_slope, const real *restrict u, const real *restrict v,
                          real *restrict adjoint)
{
    int n = D;
    for (int i = 0; i < D; ++i) {
        adjoint[i] = -diagonal_slope[i] * u[i] * v[i];
        for (int j = 0; j < i; ++j) adjoint[n++] = -u[i] * v[j];
    }
}

/* y = L x and y = L^T x, L lower triangular and row-major */
static void times(const real *restrict L, const real *restrict x, real *restrict y)
{
    for (int i = 0; i < D; ++i) {
        y[i] = 0;
        for (int j = 0; j <= i; ++j) y[i] += L[i * D + j] * x[j];
    }
}

static void times_transposed(const real *restrict L, const real *restrict x, real *restrict y)
{
    for (int j = 0; j < D; ++j) {
        y[j] = 0;
        for (int i = j; i < D; ++i) y[j] += L[i * D + j] * x[i];
    }
}
"""
_DELAN_MOTION = """
/* L, and the force that a motion without acceleration takes: dM/dt qd - dT/dq + dV/dq and friction.
 * With u = L^T qd: dM/dt qd = L (dL/dt^T qd) + dL/dt u, and dT/dq is the pull-back of qd u^T through dL/dq. */
static void motion(const real *restrict q, const real *restrict qd, real *restrict L, real *restrict bias)
{
    real L_rate[D * D], diagonal_slope[D], u[D], v[D], force[D];
${features}    times_transposed(L, qd, u);
    pack_covector(diagonal_slope, qd, u, adjoint);
${pull_back}    times_transposed(L_rate, qd, v);
    times(L, v, bias);
    for (int i = 0; i < D; ++i) {
        for (int j = 0; j <= i; ++j) bias[i] += L_rate[i * D + j] * u[j];
        bias[i] += force[i]${friction};
    }
}
"""
_DELAN = {
    "inverse_dynamics": """\
    real L[D * D], bias[D], v[D];
    motion(q, qd, L, bias);
    times_transposed(L, qdd, v);
    times(L, v, tau);
    for (int i = 0; i < D; ++i) tau[i] += bias[i];
""",
    "forward_dynamics": """\
    real L[D * D], bias[D], v[D];
    motion(q, qd, L, bias);
    for (int i = 0; i < D; ++i) bias[i] = tau[i] - bias[i];
    solve_lower(L, bias, v);
    solve_lower_transposed(L, v, qdd);
""",
    "mass_matrix": """\
    real L[D * D];
${factor_values}    for (int i = 0; i < D; ++i) times(L, &L[i * D], &M[i * D]);
""",
}
_HAMILTONIAN_MOTION = """
/* L with M^-1 = L L^T, and for u = L^-1 qd, p = L^-T u:
 * drift = dL/dt u, momentum_drift = dL/dt^T p, load = dT/dq + dV/dq and friction. */
static void motion(const real *restrict q, const real *restrict qd, real *restrict L, real *restrict drift,
                   real *restrict momentum_drift, real *restrict load)
{
    real L_rate[D * D], diagonal_slope[D], u[D], p[D], force[D];
${features}    solve_lower(L, qd, u);
    solve_lower_transposed(L, u, p);
    times(L_rate, u, drift);
    times_transposed(L_rate, p, momentum_drift);
    for (int i = 0; i < D; ++i) u[i] = -u[i];
    pack_covector(diagonal_slope, p, u, adjoint);
${pull_back}    for (int i = 0; i < D; ++i) load[i] = force[i]${friction};
}
"""
_HAMILTONIAN = {
    "inverse_dynamics": """\
    real L[D * D], drift[D], momentum_drift[D], load[D], v[D];
    motion(q, qd, L, drift, momentum_drift, load);
    for (int i = 0; i < D; ++i) drift[i] = qdd[i] - drift[i];
    solve_lower(L, drift, v);
    for (int i = 0; i < D; ++i) v[i] -= momentum_drift[i];
    solve_lower_transposed(L, v, tau);
    for (int i = 0; i < D; ++i) tau[i] += load[i];
""",
    "forward_dynamics": """\
    real L[D * D], drift[D], momentum_drift[D], load[D], v[D];
    motion(q, qd, L, drift, momentum_drift, load);
    for (int i = 0; i < D; ++i) load[i] = tau[i] - load[i];
    times_transposed(L, load, v);
    for (int i = 0; i < D; ++i) v[i] += momentum_drift[i];
    times(L, v, qdd);
    for (int i = 0; i < D; ++i) qdd[i] += drift[i];
""",
    "mass_matrix": """\
    real L[D * D], unit[D], v[D];
${factor_values}    for (int i = 0; i < D; ++i) {
        for (int j = 0; j < D; ++j) unit[j] = i == j;
        solve_lower(L, unit, v);
        solve_lower_transposed(L, v, &M[i * D]);
    }
""",
}
_ENERGY = """\
    real L[D * D], u[D], energy = 0;
${values}    ${velocity}(L, qd, u);
    for (int i = 0; i < D; ++i) energy += u[i] * u[i];
    return energy / 2${potential};
"""
# The network along the motion: its features, its outputs and their rates.
_FEATURES = """\
    real x[FEATURES], x_rate[FEATURES], x_adjoint[FEATURES], entries[${outputs}], rate[${outputs}],
        adjoint[${outputs}];
${potential_trace}    factor_trace trace;
    features(q, x);
    feature_rates(x, qd, x_rate);
    factor_rates(x, x_rate, &trace, entries, rate);
    unpack_factor_rate(entries, rate, L, L_rate, diagonal_slope);
"""
_VALUES = """\
    real x[FEATURES], entries[${outputs}];
${potential_result}    features(q, x);
    factor_value(x, entries);
    unpack_factor(entries, L);
"""
# The potential of a network of its own: where it lives, its pull-back and its value.
_POTENTIAL_TRACE = """\
    const real one = 1;
    potential_trace potential;
    real potential_adjoint[FEATURES];
"""
_PULL_BACK_POTENTIAL = """\
    potential_slopes(x, &potential);
    potential_pull_back(&potential, &one, potential_adjoint);
    for (int k = 0; k < FEATURES; ++k) x_adjoint[k] += potential_adjoint[k];
"""


def source(description: dict[str, Any], parameters: Any, needs: Needs, precision: str) -> str:
    """Body of the C source, with `$name` and `${f}` left to fill in."""
    kind = description["name"]
    if CATALOGUE[kind].properties.canonical:
        motion, bodies, velocity = _HAMILTONIAN_MOTION, _HAMILTONIAN, "solve_lower"
    else:
        motion, bodies, velocity = _DELAN_MOTION, _DELAN, "times_transposed"
    shared = "energies/~/linear_0" in parameters
    factor = c_networks.from_haiku("factor", parameters, "energies" if shared else "cholesky")
    friction = c_networks.friction_from_haiku(parameters)
    d, features = needs.degrees_of_freedom, c_networks.feature_count(needs)
    head = f"enum {{ D = {d}, FEATURES = {features}, ENTRIES = {d * (d + 1) // 2} }};\n"
    for constant in ("diagonal_shift", "diagonal_floor"):
        head += f"#define {constant.upper()} {number(float(description[constant]), precision)}\n"
    networks = c_networks.tables(factor, precision)
    functions = c_networks.feature_functions(needs) + c_networks.trace(factor)
    functions += c_networks.value(factor) + c_networks.rates(factor) + c_networks.pull_back(factor)
    trace, result, value = "", "", ""
    pull_back = "    adjoint[ENTRIES] = 1; /* the potential */\n" * shared
    pull_back += "    factor_pull_back(&trace, adjoint, x_adjoint);\n"
    energy = " + entries[ENTRIES]" * shared
    if needs.gravity and not shared:
        potential = c_networks.from_haiku("potential", parameters, "potential")
        networks += c_networks.tables(potential, precision)
        functions += c_networks.trace(potential) + c_networks.value(potential)
        functions += c_networks.slopes(potential, with_value=False) + c_networks.pull_back(potential)
        trace, result, value = _POTENTIAL_TRACE, "    real potential;\n", "    potential_value(x, &potential);\n"
        pull_back += _PULL_BACK_POTENTIAL
        energy = " + potential"
    outputs = "ENTRIES + 1" if shared else "ENTRIES"
    body = Template(motion + definitions(kind, {**bodies, "energy": _ENERGY})).safe_substitute(
        features=Template(_FEATURES).substitute(outputs=outputs, potential_trace=trace),
        pull_back=pull_back + "    pull_back_features(x, x_adjoint, force);\n",
        friction="" if friction is None else " + friction[i] * qd[i]",
        values=Template(_VALUES).substitute(outputs=outputs, potential_result=result) + value,
        factor_values=Template(_VALUES).substitute(outputs=outputs, potential_result=""),
        velocity=velocity,
        potential=energy,
    )
    return head + friction_table(friction, precision) + networks + functions + _FACTOR + body
