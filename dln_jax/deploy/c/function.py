"""Differential networks and feed-forward baselines as C: values of networks, and a Jacobian."""

from functools import partial
from string import Template
from typing import Any

import numpy as np

from dln_jax.deploy.c import networks as c_networks
from dln_jax.deploy.c.interface import FUNCTION, definitions
from dln_jax.deploy.c.networks import Network
from dln_jax.nn.differential_mlp import Layers, cheaper_jacobian
from dln_jax.types import Needs

# Of each member of the ensemble: its value, and its Jacobian by either of two passes, or that of a linear function.
_SUM = "for (int k = 0; k < OUTPUTS; ++k) y[k] += one[k] / MEMBERS;\n"
_VALUE = "    ${member}_value(x, one);\n"
_TRACED = "    {\n        ${member}_trace trace;\n        ${member}_slopes(x, &trace, one);\n"
_BACKWARD = """\
        for (int k = 0; k < OUTPUTS; ++k) {
            real unit[OUTPUTS] = {0}, row[INPUTS];
            unit[k] = 1;
            ${member}_pull_back(&trace, unit, row);
            for (int j = 0; j < INPUTS; ++j) jacobian[k * INPUTS + j] += row[j] / MEMBERS;
        }
"""
_FORWARD = """\
        for (int j = 0; j < INPUTS; ++j) {
            real unit[INPUTS] = {0}, column[OUTPUTS];
            unit[j] = 1;
            ${member}_push(&trace, unit, column);
            for (int k = 0; k < OUTPUTS; ++k) jacobian[k * INPUTS + j] += column[k] / MEMBERS;
        }
"""
_LINEAR = "    {\n        for (int k = 0; k < OUTPUTS * INPUTS; ++k) jacobian[k] += ${member}_weight_1[k] / MEMBERS;\n"
_START = "    real one[OUTPUTS];\n    for (int k = 0; k < OUTPUTS; ++k) y[k] = 0;\n"
_CLEAR = "    for (int k = 0; k < OUTPUTS * INPUTS; ++k) jacobian[k] = 0;\n"
_FEED_FORWARD = """
void ${name}_${quantity}_dynamics(const real q[D], const real qd[D], const real ${given}[D], real ${wanted}[D])
{
    real x[FEATURES + 2 * D];
    features(q, x);
    for (int i = 0; i < D; ++i) x[FEATURES + i] = qd[i] / rate_scale[i];
    for (int i = 0; i < D; ++i) x[FEATURES + D + i] = ${given}[i] / ${given_scale}[i];
    ${quantity}_value(x, ${wanted});
    for (int i = 0; i < D; ++i) ${wanted}[i] *= ${wanted_scale}[i];
}
"""


def source(layers: Layers, precision: str) -> str:
    """Body of the C source of a differential network; `layers` have the members of the ensemble first."""
    members = [
        Network(f"member_{k + 1}", tuple((np.asarray(w[k]), np.asarray(b[k])) for w, b in layers))
        for k in range(layers[0][0].shape[0])
    ]
    sizes = [members[0].sizes[0], *(len(bias) for _, bias in members[0].layers)]
    slopes = partial(c_networks.slopes, with_value=True)
    if len(sizes) == 2:
        passes, jacobian = (), _VALUE + _LINEAR
    elif cheaper_jacobian(sizes) == "backward":
        passes, jacobian = (c_networks.trace, slopes, c_networks.pull_back), _TRACED + _BACKWARD
    else:
        passes, jacobian = (c_networks.trace, slopes, c_networks.push), _TRACED + _FORWARD
    text = f"enum {{ INPUTS = {sizes[0]}, OUTPUTS = {sizes[-1]}, MEMBERS = {len(members)} }};\n"
    for member in members:
        text += c_networks.tables(member, precision)
        text += "".join(definition(member) for definition in (c_networks.value, *passes))
    values, jacobians = (
        "".join(Template(each).substitute(member=member.name) for member in members)
        for each in (f"{_VALUE}    {_SUM}", f"{jacobian}        {_SUM}    }}\n")
    )
    bodies = {"value": _START + values, "value_and_jacobian": _START + _CLEAR + jacobians}
    return text + definitions(FUNCTION, bodies)


def feed_forward_source(description: dict[str, Any], parameters: Any, needs: Needs, precision: str) -> str:
    """Body of the C source of the two networks of `models.baselines`."""
    d, features = needs.degrees_of_freedom, c_networks.feature_count(needs)
    text = [f"enum {{ D = {d}, FEATURES = {features} }};\n\n/* Typical sizes of qd, qdd and tau */\n"]
    scales = {"qdd": "acceleration_scale", "tau": "tau_scale"}
    for scale in ("rate_scale", *scales.values()):
        text.append(c_networks.scale_table(description, scale, needs, precision))
    text.append(c_networks.feature_functions(needs, ("features",)))
    for quantity, given, wanted in (("inverse", "qdd", "tau"), ("forward", "tau", "qdd")):
        network = c_networks.from_haiku(quantity, parameters, quantity)
        body = Template(_FEED_FORWARD).safe_substitute(
            quantity=quantity, given=given, wanted=wanted, given_scale=scales[given], wanted_scale=scales[wanted]
        )
        text += [c_networks.tables(network, precision), c_networks.value(network), body]
    return "".join(text)
