"""Black-box Lagrangian and Hamiltonian as C: `mechanics.lagrangian` and `mechanics.hamiltonian` of one network.

All second derivatives are rates of the gradient along a direction, one pass forward and one back each.
"""

from string import Template
from typing import Any

from dln_jax.deploy.c import networks as c_networks
from dln_jax.deploy.c.interface import definitions
from dln_jax.deploy.c.text import friction_table
from dln_jax.types import Needs
from dln_jax.zoo.catalogue import CATALOGUE

_STATE = """
/* What the network sees of the state: features of q, then ${second} / ${scale}. */
static void inputs(const real *restrict q, const real *restrict ${second}, real *restrict x)
{
    features(q, x);
    for (int i = 0; i < D; ++i) x[FEATURES + i] = ${second}[i] / ${scale}[i];
}

/* Second derivatives of the network's value in ${second}, row by row */
static void hessian(const energy_trace *restrict trace, real *restrict H)
{
    for (int i = 0; i < D; ++i) {
        real direction[INPUTS] = {0}, rate[INPUTS];
        direction[FEATURES + i] = 1 / ${scale}[i];
        energy_gradient_rate(trace, direction, rate);
        for (int j = 0; j < D; ++j) H[i * D + j] = rate[FEATURES + j] / ${scale}[j];
    }
}
"""
# The gradient of the energy at (q, qd), and its rate where q changes at qd and the other half of the state as given.
_STATE_GRADIENT = """\
    energy_trace trace;
    ${place}(q, qd, x);
    energy_gradient(x, &trace, slope);
"""
_RATE = """\
    feature_rates(x, qd, x_rate);
    for (int i = 0; i < D; ++i) x_rate[FEATURES + i] = ${other};
    energy_gradient_rate(&trace, x_rate, rate);
    pull_back_features(x, slope, force);
"""
_LAGRANGIAN = {
    "inverse_dynamics": """\
    real x[INPUTS], x_rate[INPUTS], slope[INPUTS], rate[INPUTS], force[D];
${at_qdd}    for (int i = 0; i < D; ++i) tau[i] = rate[FEATURES + i] / rate_scale[i] - force[i]${friction};
""",
    "forward_dynamics": """\
    real x[INPUTS], x_rate[INPUTS], slope[INPUTS], rate[INPUTS], force[D], M[D * D];
${at_rest}    for (int i = 0; i < D; ++i) qdd[i] = tau[i] - (rate[FEATURES + i] / rate_scale[i] - force[i]${friction});
    hessian(&trace, M);
    eliminate_1(M, qdd);
""",
    "energy": """\
    real x[INPUTS], slope[INPUTS], energy;
    energy_trace trace;
    inputs(q, qd, x);
    energy = -energy_gradient(x, &trace, slope);
    for (int i = 0; i < D; ++i) energy += slope[FEATURES + i] / rate_scale[i] * qd[i];
    return energy;
""",
    "mass_matrix": """\
    real x[INPUTS], slope[INPUTS];
${state}    hessian(&trace, M);
""",
}
_MOMENTUM = """
/* p where dH/dp = qd, by a fixed number of full Newton steps from 0; leaves the state (q, p) in x. */
static void momentum(const real *restrict q, const real *restrict qd, real *restrict x)
{
    real p[D] = {0};
    inputs(q, p, x);
    for (int step = 0; step < NEWTON_STEPS; ++step) {
        real slope[INPUTS], residual[D], H[D * D];
        energy_trace trace;
        energy_gradient(x, &trace, slope);
        for (int i = 0; i < D; ++i) residual[i] = slope[FEATURES + i] / momentum_scale[i] - qd[i];
        hessian(&trace, H);
        eliminate_1(H, residual);
        for (int i = 0; i < D; ++i) p[i] -= residual[i];
        for (int i = 0; i < D; ++i) x[FEATURES + i] = p[i] / momentum_scale[i];
    }
}
"""
_HAMILTONIAN = {
    "inverse_dynamics": """\
    real x[INPUTS], x_rate[INPUTS], slope[INPUTS], rate[INPUTS], force[D], momentum_rate[D], H[D * D];
${at_rest}    for (int i = 0; i < D; ++i) momentum_rate[i] = qdd[i] - rate[FEATURES + i] / momentum_scale[i];
    hessian(&trace, H);
    eliminate_1(H, momentum_rate);
    for (int i = 0; i < D; ++i) tau[i] = momentum_rate[i] + force[i]${friction};
""",
    "forward_dynamics": """\
    real x[INPUTS], x_rate[INPUTS], slope[INPUTS], rate[INPUTS], force[D];
${state}    pull_back_features(x, slope, force);
    feature_rates(x, qd, x_rate);
    for (int i = 0; i < D; ++i) x_rate[FEATURES + i] = (tau[i] - (force[i]${friction})) / momentum_scale[i];
    energy_gradient_rate(&trace, x_rate, rate);
    for (int i = 0; i < D; ++i) qdd[i] = rate[FEATURES + i] / momentum_scale[i];
""",
    "energy": """\
    real x[INPUTS], energy;
    momentum(q, qd, x);
    energy_value(x, &energy);
    return energy;
""",
    "mass_matrix": """\
    real x[INPUTS], slope[INPUTS], H[D * D];
${state}    hessian(&trace, H);
    for (int i = 0; i < D; ++i)
        for (int j = 0; j < D; ++j) M[i * D + j] = i == j;
    eliminate_${degrees}(H, M);
""",
}


def source(description: dict[str, Any], parameters: Any, needs: Needs, precision: str) -> str:
    """Body of the C source, with `$name` and `${f}` left to fill in."""
    kind, d, features = description["name"], needs.degrees_of_freedom, c_networks.feature_count(needs)
    head = f"enum {{ D = {d}, FEATURES = {features}, INPUTS = {features + d}"
    if CATALOGUE[kind].properties.canonical:
        network = c_networks.from_haiku("energy", parameters, "hamiltonian")
        head += f", NEWTON_STEPS = {description['iterations']}"
        scale, second, place, value = "momentum_scale", "p", "momentum", c_networks.value(network)
        text = _STATE + _MOMENTUM + definitions(kind, _HAMILTONIAN)
    else:
        network = c_networks.from_haiku("energy", parameters, "lagrangian")
        scale, second, place, value = "rate_scale", "qd", "inputs", ""
        text = _STATE + definitions(kind, _LAGRANGIAN)
    friction = c_networks.friction_from_haiku(parameters)
    head += f" }};\n\n/* Typical size of {second}, by which it is divided */\n"
    head += c_networks.scale_table(description, scale, needs, precision) + friction_table(friction, precision)
    functions = c_networks.feature_functions(needs) + c_networks.trace(network, bends=True) + value
    functions += c_networks.gradient(network) + c_networks.gradient_rate(network)
    gradient = Template(_STATE_GRADIENT).substitute(place=place)
    rates = Template(gradient + _RATE)
    body = Template(text).safe_substitute(
        state=gradient,
        at_rest=rates.substitute(other="0"),
        at_qdd=rates.substitute(other="qdd[i] / rate_scale[i]"),
        second=second,
        scale=scale,
        degrees=d,
        friction="" if friction is None else " + friction[i] * qd[i]",
    )
    return head + c_networks.tables(network, precision) + functions + body
