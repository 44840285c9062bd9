"""Differential networks and feed-forward baselines as C: values of networks, and a Jacobian."""

from typing import Any

import numpy as np

from dln_jax.deploy.c import joints as c_joints
from dln_jax.deploy.c import networks as c_networks
from dln_jax.deploy.c.networks import Network
from dln_jax.deploy.c.text import table
from dln_jax.models.black_box import per_coordinate
from dln_jax.nn.differential_mlp import Layers, cheaper_jacobian
from dln_jax.types import Needs

_BACKWARD = """        for (int k = 0; k < OUTPUTS; ++k) {
            real unit[OUTPUTS] = {0}, row[INPUTS];
            unit[k] = 1;
            ${member}_pull_back(&trace, unit, row);
            for (int j = 0; j < INPUTS; ++j) jacobian[k * INPUTS + j] += row[j] / MEMBERS;
        }
"""
_FORWARD = """        for (int j = 0; j < INPUTS; ++j) {
            real unit[INPUTS] = {0}, column[OUTPUTS];
            unit[j] = 1;
            ${member}_push(&trace, unit, column);
            for (int k = 0; k < OUTPUTS; ++k) jacobian[k * INPUTS + j] += column[k] / MEMBERS;
        }
"""
_LINEAR = """        for (int k = 0; k < OUTPUTS * INPUTS; ++k) jacobian[k] += ${member}_weight_1[k] / MEMBERS;
"""
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
    first = members[0]
    sizes = [first.sizes[0], *(len(bias) for _, bias in first.layers)]
    backward = cheaper_jacobian(sizes) == "backward"
    head = f"enum {{ INPUTS = {sizes[0]}, OUTPUTS = {sizes[-1]}, MEMBERS = {len(members)} }};\n"
    functions, values, jacobians = [], [], []
    for member in members:
        functions.append(c_networks.tables(member, precision) + c_networks.value(member))
        values.append(
            f"    {member.name}_value(x, one);\n    for (int k = 0; k < OUTPUTS; ++k) y[k] += one[k] / MEMBERS;\n"
        )
        if not first.widths:
            jacobians.append(f"    {member.name}_value(x, one);\n    {{\n" + _LINEAR.replace("${member}", member.name))
        else:
            functions.append(c_networks.trace(member) + c_networks.slopes(member, with_value=True))
            functions.append((c_networks.pull_back if backward else c_networks.push)(member))
            jacobians.append(
                f"    {{\n        {member.name}_trace trace;\n        {member.name}_slopes(x, &trace, one);\n"
                + (_BACKWARD if backward else _FORWARD).replace("${member}", member.name)
            )
        jacobians.append("        for (int k = 0; k < OUTPUTS; ++k) y[k] += one[k] / MEMBERS;\n    }\n")
    start = "    real one[OUTPUTS];\n    for (int k = 0; k < OUTPUTS; ++k) y[k] = 0;\n"
    clear = "    for (int k = 0; k < OUTPUTS * INPUTS; ++k) jacobian[k] = 0;\n"
    return (
        head
        + "".join(functions)
        + f"\nvoid ${{name}}_value(const real x[INPUTS], real y[OUTPUTS])\n{{\n{start}{''.join(values)}}}\n"
        + "\nvoid ${name}_value_and_jacobian(const real x[INPUTS], real y[OUTPUTS], real jacobian[OUTPUTS * INPUTS])\n"
        + f"{{\n{start}{clear}{''.join(jacobians)}}}\n"
    )


def feed_forward_source(description: dict[str, Any], parameters: Any, needs: Needs, precision: str) -> str:
    """Body of the C source of the two networks of `models.feed_forward`."""
    d, features = needs.degrees_of_freedom, c_joints.count(needs)
    text = [f"enum {{ D = {d}, FEATURES = {features} }};\n\n/* Typical sizes of qd, qdd and tau */\n"]
    for scale in ("rate_scale", "acceleration_scale", "tau_scale"):
        size = description[scale]
        sizes = per_coordinate(needs, scale, tuple(size) if isinstance(size, list) else size)
        text.append(table(scale, np.array(sizes), precision))
    text.append(c_joints.functions(needs, ("features",)))
    for quantity, given, wanted in (("inverse", "qdd", "tau"), ("forward", "tau", "qdd")):
        network = c_networks.from_haiku(quantity, parameters, quantity)
        body = _FEED_FORWARD
        scales = {"qdd": "acceleration_scale", "tau": "tau_scale"}
        texts = {"quantity": quantity, "given": given, "wanted": wanted}
        texts |= {"given_scale": scales[given], "wanted_scale": scales[wanted]}
        for key, value in texts.items():
            body = body.replace(f"${{{key}}}", value)
        text += [c_networks.tables(network, precision), c_networks.value(network), body]
    return "".join(text)
