"""Networks as C functions: value, rate along a direction, pull-back of a covector, curvature; and their inputs.

What a network sees of the coordinates is `models.networks.joint_features`.

The layer rules are those of `nn.differential_mlp`. With a_l = h_(l-1) W_l + b_l and h_l = g(a_l):

- rate along x_rate: a_l' = h_(l-1)' W_l, h_l' = g'(a_l) a_l';
- pull-back of lambda_L = W_(L+1) y_adjoint: lambda_(l-1) = W_l (g'(a_l) lambda_l), which ends as x_adjoint;
- rate of the gradient of one output: lambda_(l-1)' = W_l (g''(a_l) lambda_l a_l' + g'(a_l) lambda_l'), lambda_L' = 0.

Hidden layers are padded with units of zero weight to a multiple of 8, so that all loops vectorise without remainders.
"""

from collections.abc import Iterable
from textwrap import indent
from typing import Any, NamedTuple

import numpy as np

from dln_jax.deploy.c.text import table
from dln_jax.models.networks import per_coordinate
from dln_jax.types import Needs

_LANES = 8
# What is below a layer, where that is the first.
_BELOW = {"h": "x", "h_rate": "x_rate", "adjoint": "x_adjoint"}
# Lines of one layer, as `_at` fills them in.
_COMBINE = "combine_{below}_{width}({weight}, {bias}, {h}, a_{l});\n"
_SCALE_RATE = "for (int k = 0; k < {width}; ++k) h_rate_{l}[k] *= trace->slope_{l}[k];\n"
_SCALE_ADJOINT = "for (int k = 0; k < {width}; ++k) adjoint_{l}[k] *= trace->slope_{l}[k];\n"
_BACK = "dots_{below}_{width}({weight}, adjoint_{l}, {adjoint});\n"
_OUTPUT = "dots_{width}_{below}({weight}, {h}, y);\nfor (int k = 0; k < {width}; ++k) y[k] += {bias}[k];\n"
_OUTPUT_RATE = "dots_{width}_{below}({weight}, {h_rate}, y_rate);\n"

_FEATURES = {
    "features": """
/* cos of the revolute joints, sin of them, then the prismatic ones */
static void features(const real *restrict q, real *restrict x)
""",
    "feature_rates": """
/* Rate of the features x where q changes at qd */
static void feature_rates(const real *restrict x, const real *restrict qd, real *restrict x_rate)
""",
    "pull_back_features": """
/* sum_k x_adjoint[k] dx_k/dq */
static void pull_back_features(const real *restrict x, const real *restrict x_adjoint, real *restrict force)
""",
}


class Network(NamedTuple):
    """A multilayer perceptron."""

    name: str
    """Prefix of its C names."""
    layers: tuple[tuple[np.ndarray, np.ndarray], ...]
    """(weight [in, out], bias [out]), hidden layers first."""

    @property
    def sizes(self) -> list[int]:
        """n, the padded widths of the hidden layers, m."""
        widths = [-(-len(bias) // _LANES) * _LANES for _, bias in self.layers[:-1]]
        return [self.layers[0][0].shape[0], *widths, self.layers[-1][0].shape[1]]

    @property
    def last(self) -> int:
        """Number of the output layer; the hidden ones are from 1."""
        return len(self.layers)


def feature_count(needs: Needs) -> int:
    """Number of features."""
    return sum(2 if joint == "revolute" else 1 for joint in needs.joints)


def scale_table(description: dict[str, Any], scale: str, needs: Needs, precision: str) -> str:
    """The sizes by which a model divides, one for each coordinate."""
    size = description[scale]
    return table(scale, per_coordinate(needs, scale, tuple(size) if isinstance(size, list) else size), precision)


def feature_functions(needs: Needs, names: Iterable[str] = _FEATURES) -> str:
    """Definitions of `features(q, x)`, `feature_rates(x, qd, x_rate)` and `pull_back_features(x, x_adjoint, force)`."""
    revolute, prismatic = (
        [joint for joint, kind in enumerate(needs.joints) if kind == wanted] for wanted in ("revolute", "prismatic")
    )
    n = len(revolute)
    # Lines of each function; without a revolute joint, two of them do not use x.
    values, rates, forces = [], [] if n else ["(void)x;"], [] if n else ["(void)x;"]
    for k, joint in enumerate(revolute):
        values += [f"x[{k}] = cos${{f}}(q[{joint}]);", f"x[{n + k}] = sin${{f}}(q[{joint}]);"]
        rates += [f"x_rate[{k}] = -x[{n + k}] * qd[{joint}];", f"x_rate[{n + k}] = x[{k}] * qd[{joint}];"]
        forces.append(f"force[{joint}] = x[{k}] * x_adjoint[{n + k}] - x[{n + k}] * x_adjoint[{k}];")
    for k, joint in enumerate(prismatic, start=2 * n):
        values.append(f"x[{k}] = q[{joint}];")
        rates.append(f"x_rate[{k}] = qd[{joint}];")
        forces.append(f"force[{joint}] = x_adjoint[{k}];")
    lines = dict(zip(_FEATURES, (values, rates, forces), strict=True))
    return "".join(_FEATURES[name] + "{\n" + "".join(f"    {line}\n" for line in lines[name]) + "}\n" for name in names)


def from_haiku(name: str, parameters, module: str) -> Network:
    """The network that Haiku's MLP of that name has in the parameters."""
    layers = []
    while (key := f"{module}/~/linear_{len(layers)}") in parameters:
        layers.append((np.asarray(parameters[key]["w"]), np.asarray(parameters[key]["b"])))
    return Network(name, tuple(layers))


def friction_from_haiku(parameters) -> np.ndarray | None:
    """Coefficients of viscous friction [d] beside a network, if there are any: softplus of its parameters."""
    friction = parameters.get("~", {}).get("viscous_friction")
    return None if friction is None else np.logaddexp(0, np.asarray(friction, np.float64))


def tables(network: Network, precision: str) -> str:
    """Weights and biases. The last weight is stored [out][in], the others [in][out]."""
    hidden = ", ".join(str(len(bias)) for _, bias in network.layers[:-1]) or "none"
    sizes = f"{network.sizes[0]} inputs, hidden units {hidden}, {network.sizes[-1]} outputs"
    text = f"\n/* Network `{network.name}`: {sizes}; hidden units padded to a multiple of {_LANES}. */\n"
    for layer, (weight, bias) in enumerate(network.layers, start=1):
        rows, columns = network.sizes[layer - 1 : layer + 1]
        padded = np.pad(weight, ((0, rows - weight.shape[0]), (0, columns - weight.shape[1])))
        text += table(f"{network.name}_weight_{layer}", padded.T if layer == network.last else padded, precision)
        text += table(f"{network.name}_bias_{layer}", np.pad(bias, (0, columns - len(bias))), precision)
    return text


def value(network: Network) -> str:
    """`NAME_value(x, y)`."""
    up = "real a_{l}[{width}], h_{l}[{width}];\n" + _COMBINE + "activate_{width}(a_{l}, h_{l});\n"
    body = _hidden(network, up) + _at(network, [network.last], _OUTPUT)
    return _function(network, "value", "const real *restrict x, real *restrict y", body, "y at x")


def slopes(network: Network, *, with_value: bool) -> str:
    """`NAME_slopes(x, trace)`, or `NAME_slopes(x, trace, y)` with the value."""
    up = "real a_{l}[{width}], h_{l}[{width}];\n" + _COMBINE
    body = _hidden(network, up + "activate_with_slope_{width}(a_{l}, h_{l}, trace->slope_{l});\n")
    body += _at(network, [network.last] * with_value, _OUTPUT)
    parameters = "const real *restrict x, {name}_trace *restrict trace" + ", real *restrict y" * with_value
    return _function(network, "slopes", parameters, body, f"{'y and ' * with_value}g' of the hidden units at x")


def rates(network: Network) -> str:
    """`NAME_rates(x, x_rate, trace, y, y_rate)`."""
    up = (
        "real a_{l}[{width}], h_{l}[{width}], h_rate_{l}[{width}];\n"
        "combine_rates_{below}_{width}({weight}, {bias}, {h}, {h_rate}, a_{l}, h_rate_{l});\n"
        "activate_with_slope_{width}(a_{l}, h_{l}, trace->slope_{l});\n"
    )
    body = _hidden(network, up + _SCALE_RATE) + _at(network, [network.last], _OUTPUT + _OUTPUT_RATE)
    parameters = (
        "const real *restrict x, const real *restrict x_rate, {name}_trace *restrict trace, "
        "real *restrict y, real *restrict y_rate"
    )
    return _function(network, "rates", parameters, body, "y at x, and its rate where x changes at x_rate")


def push(network: Network) -> str:
    """`NAME_push(trace, x_rate, y_rate)`."""
    up = "real h_rate_{l}[{width}];\npush_{below}_{width}({weight}, {h_rate}, h_rate_{l});\n"
    body = _hidden(network, up + _SCALE_RATE) + _at(network, [network.last], _OUTPUT_RATE)
    parameters = "const {name}_trace *restrict trace, const real *restrict x_rate, real *restrict y_rate"
    return _function(network, "push", parameters, body, "Rate of y where x changes at x_rate")


def pull_back(network: Network) -> str:
    """`NAME_pull_back(trace, y_adjoint, x_adjoint)`."""
    declare = "real {adjoint}[{below}];\n"
    body = _at(network, [network.last], declare + "push_{width}_{below}({weight}, y_adjoint, {adjoint});\n")
    body += _at(network, range(network.last - 1, 1, -1), _SCALE_ADJOINT + declare + _BACK)
    body += _at(network, [1], _SCALE_ADJOINT + _BACK)
    parameters = "const {name}_trace *restrict trace, const real *restrict y_adjoint, real *restrict x_adjoint"
    return _function(network, "pull_back", parameters, body, "sum_k y_adjoint[k] dy_k/dx")


def gradient(network: Network) -> str:
    """`NAME_gradient(x, trace, x_adjoint)` of the one output, which it returns."""
    up = "real a_{l}[{width}], h_{l}[{width}], adjoint_{l}[{width}];\n" + _COMBINE
    up += "activate_with_curvature_{width}(a_{l}, h_{l}, trace->slope_{l}, trace->bend_{l});\n"
    turn = "real y;\ndots_{width}_{below}({weight}, {h}, &y);\ny += {bias}[0];\n"
    turn += "for (int k = 0; k < {below}; ++k) {adjoint}[k] = {weight}[k];\n"
    bend = "for (int k = 0; k < {width}; ++k) trace->bend_{l}[k] *= adjoint_{l}[k];\n"
    body = _hidden(network, up) + _at(network, [network.last], turn)
    body += _at(network, range(network.last - 1, 0, -1), bend + _SCALE_ADJOINT + _BACK) + "return y;\n"
    parameters = "const real *restrict x, {name}_trace *restrict trace, real *restrict x_adjoint"
    return _function(network, "gradient", parameters, body, "y and dy/dx at x", result="real")


def gradient_rate(network: Network) -> str:
    """`NAME_gradient_rate(trace, x_rate, x_adjoint_rate)`."""
    highest = network.last - 1
    up = "real a_rate_{l}[{width}], adjoint_{l}[{width}];\npush_{below}_{width}({weight}, {h_rate}, a_rate_{l});\n"
    slope = "real h_rate_{l}[{width}];\n"
    slope += "for (int k = 0; k < {width}; ++k) h_rate_{l}[k] = trace->slope_{l}[k] * a_rate_{l}[k];\n"
    down = "for (int k = 0; k < {width}; ++k)\n    adjoint_{l}[k] = trace->bend_{l}[k] * a_rate_{l}[k]"
    from_above = " + trace->slope_{l}[k] * adjoint_{l}[k]"
    body = _at(network, range(1, highest), up + slope) + _at(network, [highest], up)
    body += _at(network, [highest], down + ";\n" + _BACK)
    body += _at(network, range(highest - 1, 0, -1), down + from_above + ";\n" + _BACK)
    body = body.replace("x_adjoint", "x_adjoint_rate")
    parameters = "const {name}_trace *restrict trace, const real *restrict x_rate, real *restrict x_adjoint_rate"
    return _function(network, "gradient_rate", parameters, body, "Rate of dy/dx where x changes at x_rate")


def trace(network: Network, *, bends: bool = False) -> str:
    """The struct that a pass leaves for those after it."""
    fields = _hidden(network, "    real slope_{l}[{width}];\n" + "    real bend_{l}[{width}];\n" * bends)
    meaning = "g' of the hidden units" + ", and g'' times dy/dh" * bends
    return f"\n/* {meaning}, at one x */\ntypedef struct {{\n{fields}}} {network.name}_trace;\n"


def _hidden(network: Network, text: str) -> str:
    return _at(network, range(1, network.last), text)


def _at(network: Network, layers: Iterable[int], text: str) -> str:
    """The text for each of the layers, with its number, its sizes and the names of what is beside it filled in."""
    return "".join(
        text.format(
            l=layer,
            below=network.sizes[layer - 1],
            width=network.sizes[layer],
            weight=f"{network.name}_weight_{layer}",
            bias=f"{network.name}_bias_{layer}",
            **{key: f"{key}_{layer - 1}" if layer > 1 else at_x for key, at_x in _BELOW.items()},
        )
        for layer in layers
    )


def _function(network: Network, verb: str, parameters: str, body: str, meaning: str, *, result: str = "void") -> str:
    head = f"\n/* {meaning} */\nstatic {result} {network.name}_{verb}({parameters.format(name=network.name)})"
    return f"{head}\n{{\n{indent(body, '    ')}}}\n"
