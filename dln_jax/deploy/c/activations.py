"""Activations of exported C, with their first two derivatives.

tanh, the default, is written so that it vectorises: with m = e^-2|x| - 1 = expm1(-2|x|),

    tanh |x| = -m / (2 + m),   tanh' = 4 (1 + m) / (2 + m)²,   tanh'' = -2 tanh tanh',

and m comes from a short series at a 2^n-th of the argument and n doublings m <- m (2 + m), which lose nothing for
m < 0. The decay 1 + m is squared along with it, for its relative accuracy in saturation. The others call <math.h>.
"""

import math
from textwrap import indent

from dln_jax.deploy.c.text import fill, number

_TANH = {
    # Bound of |x| beyond which tanh rounds to 1, doublings, terms of the series.
    "f32": (10.0, 6, 8),
    "f64": (20.0, 8, 11),
}

# (lines before, value, slope, curvature) as functions of x.
_FORMULAS = {
    "relu": ("", "x < 0 ? 0 : x", "x > 0", "0"),
    "softplus": (
        "const real decay = exp${f}(-fabs${f}(x));",
        "(x < 0 ? 0 : x) + log1p${f}(decay)",
        "(x < 0 ? decay : 1) / (1 + decay)",
        "decay / ((1 + decay) * (1 + decay))",
    ),
    "cos": ("", "cos${f}(x)", "-sin${f}(x)", "-cos${f}(x)"),
    "sin": ("", "sin${f}(x)", "cos${f}(x)", "-sin${f}(x)"),
    "silu": (
        "const real decay = exp${f}(-fabs${f}(x));",
        "x * (x < 0 ? decay : 1) / (1 + decay)",
        "(x < 0 ? decay : 1) / (1 + decay) * (1 + x * (x < 0 ? 1 : decay) / (1 + decay))",
        "decay / ((1 + decay) * (1 + decay)) * (2 - fabs${f}(x) * (1 - decay) / (1 + decay))",
    ),
    "gelu": (
        "",
        "x * $half * erfc${f}(-x * $root)",
        "$half * erfc${f}(-x * $root) + x * ($density * exp${f}(-$half * x * x))",
        "$density * exp${f}(-$half * x * x) * (2 - x * x)",
    ),
    "linear": ("", "x", "1", "0"),
    "quadratic": ("", "x * x", "2 * x", "2"),
    "cubic": ("", "x * x * x", "3 * x * x", "6 * x"),
}
EXPORTABLE = ("tanh", *_FORMULAS)
"""Names of the activations."""

_RESULTS = {"value": "g(x)", "slope": "g'(x)", "curvature": "g''(x)"}
_COUNTS = {"activate": 1, "activate_with_slope": 2, "activate_with_curvature": 3}


def activate(function: str, width: int, activation: str, precision: str) -> str:
    """Definition of `activate_WIDTH`, `activate_with_slope_WIDTH` or `activate_with_curvature_WIDTH`."""
    results = list(_RESULTS)[: _COUNTS[function]]
    formulas = ", ".join(f"{name} = {_RESULTS[name]}" for name in results)
    parameters = ", ".join(f"real *restrict {name}" for name in results)
    lines = _tanh(results, precision) if activation == "tanh" else _by_formula(results, activation)
    texts = {"half": 0.5, "root": math.sqrt(0.5), "density": 1 / math.sqrt(2 * math.pi)}
    constants = {key: number(value, precision) for key, value in texts.items()}
    return (
        f"\n/* {formulas} with g = {activation} */\n"
        f"static void {function}_{width}(const real *restrict a, {parameters})\n{{\n"
        f"{fill(indent(lines, '    '), precision, width=width, **constants)}}}\n"
    )


def _by_formula(results: list[str], activation: str) -> str:
    before, *formulas = _FORMULAS[activation]
    lines = ["const real x = a[k];", *[before] * bool(before)]
    lines += [f"{name}[k] = {formula};" for name, formula in zip(results, formulas, strict=False)]
    return "for (int k = 0; k < $width; ++k) {\n" + "".join(f"    {line}\n" for line in lines) + "}\n"


def _tanh(results: list[str], precision: str) -> str:
    bound, doublings, terms = _TANH[precision]
    bound, scale = number(bound, precision), number(-2 * 2.0**-doublings, precision)
    *coefficients, last = (number(1 / math.factorial(order), precision) for order in range(2, terms + 1))
    series = "".join(f"    m = {coefficient} + z * m;\n" for coefficient in reversed(coefficients))
    with_decay = "slope" in results
    decay = "    real decay = 1 + m;\n" * with_decay
    doubling = f"    m *= 2 + m;{' decay *= decay;' * with_decay}\n"
    slope = "    slope[k] = 4 * decay * scale * scale;\n" * with_decay
    curvature = "    curvature[k] = -2 * value[k] * slope[k];\n" * ("curvature" in results)
    return f"""real clamped[$width]; /* a loop of its own, which keeps the next one free of branches */
for (int k = 0; k < $width; ++k) {{
    const real size = fabs${{f}}(a[k]);
    clamped[k] = size > {bound} ? {bound} : size;
}}
for (int k = 0; k < $width; ++k) {{
    const real z = {scale} * clamped[k];
    real m = {last};
{series}    m = z + z * z * m;
{decay}{doubling * doublings}\
    const real scale = 1 / (2 + m), t = -m * scale;
    value[k] = a[k] < 0 ? -t : t;
{slope}{curvature}}}
"""
