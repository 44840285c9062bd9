"""Multilayer perceptrons as C functions: value, rate along a direction, pull-back of a covector, curvature.

The layer rules are those of `nn.differential_mlp`. With a_l = h_(l-1) W_l + b_l and h_l = g(a_l):

- rate along x_rate: a_l' = h_(l-1)' W_l, h_l' = g'(a_l) a_l';
- pull-back of lambda_L = W_(L+1) y_adjoint: lambda_(l-1) = W_l (g'(a_l) lambda_l), which ends as x_adjoint;
- rate of the gradient of one output: lambda_(l-1)' = W_l (g''(a_l) lambda_l a_l' + g'(a_l) lambda_l'), lambda_L' = 0.

Hidden layers are padded with units of zero weight to a multiple of 8, so that all loops vectorise without remainders.
"""

from typing import NamedTuple

import numpy as np

from dln_jax.deploy.c.text import table

_LANES = 8


class Network(NamedTuple):
    """A multilayer perceptron."""

    name: str
    """Prefix of its C names."""
    layers: tuple[tuple[np.ndarray, np.ndarray], ...]
    """(weight [in, out], bias [out]), hidden layers first."""

    @property
    def inputs(self) -> int:
        """n."""
        return self.layers[0][0].shape[0]

    @property
    def outputs(self) -> int:
        """m."""
        return self.layers[-1][0].shape[1]

    @property
    def widths(self) -> list[int]:
        """Padded widths of the hidden layers."""
        return [-(-len(bias) // _LANES) * _LANES for _, bias in self.layers[:-1]]

    @property
    def sizes(self) -> list[int]:
        """n, then the padded widths."""
        return [self.inputs, *self.widths]


def from_haiku(name: str, parameters, module: str) -> Network:
    """The network that Haiku's MLP of that name has in the parameters."""
    layers = []
    while (key := f"{module}/~/linear_{len(layers)}") in parameters:
        layers.append((np.asarray(parameters[key]["w"]), np.asarray(parameters[key]["b"])))
    return Network(name, tuple(layers))


def tables(network: Network, precision: str, *, output_bias: bool = True) -> str:
    """Weights and biases. The last weight is stored [out][in], the others [in][out]."""
    hidden = ", ".join(str(len(bias)) for _, bias in network.layers[:-1]) or "none"
    sizes = f"{network.inputs} inputs, hidden units {hidden}, {network.outputs} outputs"
    text = [f"\n/* Network `{network.name}`: {sizes}; hidden units padded to a multiple of {_LANES}. */\n"]
    for index, (weight, bias) in enumerate(network.layers):
        rows = network.sizes[index]
        last = index == len(network.layers) - 1
        columns = len(bias) if last else network.widths[index]
        padded = np.zeros((rows, columns))
        padded[: weight.shape[0], : weight.shape[1]] = weight
        text.append(table(f"{network.name}_weight_{index + 1}", padded.T if last else padded, precision))
        if output_bias or not last:
            text.append(table(f"{network.name}_bias_{index + 1}", np.pad(bias, (0, columns - len(bias))), precision))
    return "".join(text)


def value(network: Network) -> str:
    """`NAME_value(x, y)`."""
    body = []
    for index, width in enumerate(network.widths, start=1):
        source = "x" if index == 1 else f"h_{index - 1}"
        body += [
            f"real a_{index}[{width}], h_{index}[{width}];",
            f"{_combine(network, index)}, {source}, a_{index});",
            f"activate_{width}(a_{index}, h_{index});",
        ]
    body += _output(network, f"h_{len(network.widths)}" if network.widths else "x", "y")
    return _function(network, "value", "const real *restrict x, real *restrict y", body, "y at x")


def slopes(network: Network, *, with_value: bool) -> str:
    """`NAME_slopes(x, trace)`, or `NAME_slopes(x, trace, y)` with the value."""
    body = []
    for index, width in enumerate(network.widths, start=1):
        source = "x" if index == 1 else f"h_{index - 1}"
        body += [
            f"real a_{index}[{width}], h_{index}[{width}];",
            f"{_combine(network, index)}, {source}, a_{index});",
            f"activate_with_slope_{width}(a_{index}, h_{index}, trace->slope_{index});",
        ]
    if with_value:
        body += _output(network, f"h_{len(network.widths)}", "y")
    parameters = f"const real *restrict x, {network.name}_trace *restrict trace"
    parameters += ", real *restrict y" * with_value
    return _function(network, "slopes", parameters, body, f"{'y and ' * with_value}g' of the hidden units at x")


def rates(network: Network) -> str:
    """`NAME_rates(x, x_rate, trace, y, y_rate)`."""
    body = []
    for index, width in enumerate(network.widths, start=1):
        source, source_rate = ("x", "x_rate") if index == 1 else (f"h_{index - 1}", f"h_rate_{index - 1}")
        table_of_layer = f"{network.name}_weight_{index}, {network.name}_bias_{index}"
        body += [
            f"real a_{index}[{width}], h_{index}[{width}], h_rate_{index}[{width}];",
            f"combine_rates_{network.sizes[index - 1]}_{width}({table_of_layer}, {source}, {source_rate}, a_{index}, "
            f"h_rate_{index});",
            f"activate_with_slope_{width}(a_{index}, h_{index}, trace->slope_{index});",
            f"for (int k = 0; k < {width}; ++k) h_rate_{index}[k] *= trace->slope_{index}[k];",
        ]
    last = len(network.widths)
    body += _output(network, f"h_{last}", "y")
    body.append(_last_dots(network, f"h_rate_{last}", "y_rate"))
    parameters = (
        f"const real *restrict x, const real *restrict x_rate, {network.name}_trace *restrict trace, "
        "real *restrict y, real *restrict y_rate"
    )
    return _function(network, "rates", parameters, body, "y at x, and its rate where x changes at x_rate")


def push(network: Network) -> str:
    """`NAME_push(trace, x_rate, y_rate)`."""
    body = []
    for index, width in enumerate(network.widths, start=1):
        source = "x_rate" if index == 1 else f"h_rate_{index - 1}"
        body += [
            f"real h_rate_{index}[{width}];",
            f"push_{network.sizes[index - 1]}_{width}({network.name}_weight_{index}, {source}, h_rate_{index});",
            f"for (int k = 0; k < {width}; ++k) h_rate_{index}[k] *= trace->slope_{index}[k];",
        ]
    body.append(_last_dots(network, f"h_rate_{len(network.widths)}", "y_rate"))
    parameters = f"const {network.name}_trace *restrict trace, const real *restrict x_rate, real *restrict y_rate"
    return _function(network, "push", parameters, body, "Rate of y where x changes at x_rate")


def pull_back(network: Network) -> str:
    """`NAME_pull_back(trace, y_adjoint, x_adjoint)`."""
    last = len(network.widths)
    body = [
        f"real adjoint_{last}[{network.widths[-1]}];",
        f"push_{network.outputs}_{network.widths[-1]}({network.name}_weight_{last + 1}, y_adjoint, adjoint_{last});",
    ]
    for index in range(last, 0, -1):
        width, below = network.widths[index - 1], network.sizes[index - 1]
        target = "x_adjoint" if index == 1 else f"adjoint_{index - 1}"
        body.append(f"for (int k = 0; k < {width}; ++k) adjoint_{index}[k] *= trace->slope_{index}[k];")
        if index > 1:
            body.append(f"real adjoint_{index - 1}[{below}];")
        body.append(f"dots_{below}_{width}({network.name}_weight_{index}, adjoint_{index}, {target});")
    parameters = f"const {network.name}_trace *restrict trace, const real *restrict y_adjoint, real *restrict x_adjoint"
    return _function(network, "pull_back", parameters, body, "sum_k y_adjoint[k] dy_k/dx")


def gradient(network: Network) -> str:
    """`NAME_gradient(x, trace, x_adjoint)` of the one output, which it returns."""
    body, last = [], len(network.widths)
    for index, width in enumerate(network.widths, start=1):
        source = "x" if index == 1 else f"h_{index - 1}"
        body += [
            f"real a_{index}[{width}], h_{index}[{width}], adjoint_{index}[{width}];",
            f"{_combine(network, index)}, {source}, a_{index});",
            f"activate_with_curvature_{width}(a_{index}, h_{index}, trace->slope_{index}, trace->bend_{index});",
        ]
    body += ["real y;", *_output(network, f"h_{last}", "&y")]
    start = f"adjoint_{last}[k] = {network.name}_weight_{last + 1}[k];"
    body.append(f"for (int k = 0; k < {network.widths[-1]}; ++k) {start}")
    for index in range(last, 0, -1):
        width, below = network.widths[index - 1], network.sizes[index - 1]
        target = "x_adjoint" if index == 1 else f"adjoint_{index - 1}"
        body += [
            f"for (int k = 0; k < {width}; ++k) trace->bend_{index}[k] *= adjoint_{index}[k];",
            f"for (int k = 0; k < {width}; ++k) adjoint_{index}[k] *= trace->slope_{index}[k];",
            f"dots_{below}_{width}({network.name}_weight_{index}, adjoint_{index}, {target});",
        ]
    body.append("return y;")
    parameters = f"const real *restrict x, {network.name}_trace *restrict trace, real *restrict x_adjoint"
    return _function(network, "gradient", parameters, body, "y and dy/dx at x", result="real")


def gradient_rate(network: Network) -> str:
    """`NAME_gradient_rate(trace, x_rate, x_adjoint_rate)`."""
    body, last = [], len(network.widths)
    for index, width in enumerate(network.widths, start=1):
        source = "x_rate" if index == 1 else f"h_rate_{index - 1}"
        body += [
            f"real a_rate_{index}[{width}], adjoint_{index}[{width}];",
            f"push_{network.sizes[index - 1]}_{width}({network.name}_weight_{index}, {source}, a_rate_{index});",
        ]
        if index < last:
            body += [
                f"real h_rate_{index}[{width}];",
                f"for (int k = 0; k < {width}; ++k) h_rate_{index}[k] = trace->slope_{index}[k] * a_rate_{index}[k];",
            ]
    for index in range(last, 0, -1):
        width, below = network.widths[index - 1], network.sizes[index - 1]
        target = "x_adjoint_rate" if index == 1 else f"adjoint_{index - 1}"
        from_above = f" + trace->slope_{index}[k] * adjoint_{index}[k]" if index < last else ""
        body += [
            f"for (int k = 0; k < {width}; ++k)\n        "
            f"adjoint_{index}[k] = trace->bend_{index}[k] * a_rate_{index}[k]{from_above};",
            f"dots_{below}_{width}({network.name}_weight_{index}, adjoint_{index}, {target});",
        ]
    parameters = (
        f"const {network.name}_trace *restrict trace, const real *restrict x_rate, real *restrict x_adjoint_rate"
    )
    return _function(network, "gradient_rate", parameters, body, "Rate of dy/dx where x changes at x_rate")


def trace(network: Network, *, bends: bool = False) -> str:
    """The struct that a pass leaves for those after it."""
    fields = "".join(
        f"    real slope_{index}[{width}];\n" + f"    real bend_{index}[{width}];\n" * bends
        for index, width in enumerate(network.widths, start=1)
    )
    meaning = "g' of the hidden units" + ", and g'' times dy/dh" * bends
    return f"\n/* {meaning}, at one x */\ntypedef struct {{\n{fields}}} {network.name}_trace;\n"


def _combine(network: Network, index: int) -> str:
    name, rows, columns = network.name, network.sizes[index - 1], network.widths[index - 1]
    return f"combine_{rows}_{columns}({name}_weight_{index}, {name}_bias_{index}"


def _last_dots(network: Network, source: str, target: str) -> str:
    weight = f"{network.name}_weight_{len(network.layers)}"
    return f"dots_{network.outputs}_{network.sizes[-1]}({weight}, {source}, {target});"


def _output(network: Network, source: str, target: str) -> list[str]:
    bias = f"{network.name}_bias_{len(network.layers)}"
    if target == "&y":
        return [_last_dots(network, source, target), f"y += {bias}[0];"]
    add = f"for (int k = 0; k < {network.outputs}; ++k) {target}[k] += {bias}[k];"
    return [_last_dots(network, source, target), add]


def _function(
    network: Network, verb: str, parameters: str, body: list[str], meaning: str, *, result: str = "void"
) -> str:
    lines = "".join(f"    {line}\n" for line in body)
    return f"\n/* {meaning} */\nstatic {result} {network.name}_{verb}({parameters})\n{{\n{lines}}}\n"
