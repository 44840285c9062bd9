"""Constants of the elementary functions in exported C: polynomials, ln 2 and pi/2 in parts, and masks of bits."""

import math

import numpy as np

from dln_jax.export.c.text import PRECISIONS, number

# From the constant term up: interpolated at Chebyshev nodes in 60 digits (mpmath), then rounded. In r or in r²,
#   exp  (e^r - 1 - r) / r², |r| <= ln(2)/2           sin, cos  (sin(r)/r - 1) / r², ((cos(r) - 1) / r² + 1/2) / r²
#   log  (2 artanh(r)/r - 2) / r², r <= 3 - 2 sqrt(2) tanh      (tanh(r)/r - 1) / r² = tanh / tanh_below, r <= 0.56
_POLYNOMIALS = {
    "f64": {
        "exp": (0.5000000000000001, 0.16666666666666669, 0.041666666666623824, 0.008333333333330039,
                0.0013888888917367081, 0.00019841269863171557, 2.4801521057868204e-05, 2.7557268276905696e-06,
                2.7620201591031547e-07, 2.5100472505694996e-08),
        "tanh": (-0.3333333333333333, -0.020501566345638482, -0.00019930065261747755),
        "tanh_below": (1.0, 0.46150469903691427, 0.023295019667899867, 0.00020666505951855979),
        "sin": (-0.16666666666666666, 0.008333333333330925, -0.00019841269836722418, 2.755731608381636e-06,
                -2.5051127944014188e-08, 1.5917848524808262e-10),
        "cos": (0.041666666666666664, -0.0013888888888887382, 2.480158729874307e-05, -2.7557317260008837e-07,
                2.0876143827993133e-09, -1.1382456778061306e-11),
        "log": (0.666666666666667, 0.3999999999989827, 0.2857142862653362, 0.22222211043776857, 0.18182895750119193,
                0.1533150161114533, 0.1461916613488797),
    },
    "f32": {
        "exp": (0.5, 0.16666667, 0.041666463, 0.0083333105, 0.0013933731, 0.0001989108),
        "tanh": (-0.3333333, -0.0015581064),
        "tanh_below": (1.0, 0.40467018),
        "sin": (-0.16666667, 0.008333332, -0.00019840083, 2.7249314e-06),
        "cos": (0.041666664, -0.00138883, 2.4547437e-05),
        "log": (0.66666687, 0.39988735, 0.29582024),
    },
}  # fmt: skip
# ln 2 and pi/2 in parts: all but the last are short enough for exact products with any n that occurs.
_LN2 = {"f64": (0.6931471805598903, 5.497923018708371e-14), "f32": (0.69314575, 1.4286068e-06)}
_HALF_PI = {
    "f64": (1.5707963267923333, 2.5633441515839558e-12, 1.0562999066987428e-23),
    "f32": (1.5703125, 0.0004837513, 7.5495336e-08, 2.563344e-12),
}
# Where e^x is the smallest normal number, and the largest.
_EXP_RANGE = {"f64": (-708.3964185322641, 709.782712893384), "f32": (-87.33654, 88.72283)}


def values_of(precision: str) -> dict[str, str]:
    """Returns the values of the placeholders in the C text."""
    numpy_type = PRECISIONS[precision][0]
    mantissa, bias = np.finfo(numpy_type).nmant, np.finfo(numpy_type).maxexp - 1
    word, suffix = {"f64": ("uint64_t", "ULL"), "f32": ("uint32_t", "U")}[precision]
    words = {
        "one": bias << mantissa, "one_half": (bias - 1) << mantissa, "fraction_mask": (1 << mantissa) - 1,
        "root_half": int(numpy_type(math.sqrt(0.5)).view(f"u{numpy_type().itemsize}")),
        "exponent_mask": 2 * bias + 1, "sign": (2 * bias + 2) << mantissa,
        "counting": (bias + mantissa) << mantissa,  # 2^mantissa, to which the low bits add what they count
    }  # fmt: skip
    *first_parts, next_part, last_part = _HALF_PI[precision]
    numbers = {
        "magic": 1.5 * 2.0**mantissa, "half": 0.5, "split": 0.55, "log2e": 1 / math.log(2), "two_over_pi": 2 / math.pi,
        "ln2_high": _LN2[precision][0], "ln2_low": _LN2[precision][1], "next_part": next_part, "last_part": last_part,
        "exp_smallest": _EXP_RANGE[precision][0], "exp_largest": _EXP_RANGE[precision][1],
        "bias": 2.0**mantissa + bias, "grown_bias": 2.0**mantissa + bias + mantissa + 2,
        "smallest": 2.0 ** (1 - bias), "growth": 2.0 ** (mantissa + 2),
    }  # fmt: skip
    head = "a"
    for part in first_parts:
        head = f"MULTIPLY_ADD(-n, {number(part, precision)}, {head})"
    exponent_bits = bias.bit_length() + 1
    values = {
        "word": word, "mantissa": str(mantissa), "to_sign": str(mantissa + exponent_bits - 1), "head": head,
        "exponent_bits": str(exponent_bits), "bias_of_exponent": str(bias),
        **{key: f"{value:#x}{suffix}" for key, value in words.items()},
        **{key: number(value, precision) for key, value in numbers.items()},
    }  # fmt: skip
    for name, coefficients in _POLYNOMIALS[precision].items():
        x, degree = "r" if name == "exp" else "z", len(coefficients) - 1
        values[name] = _polynomial(x, [number(coefficient, precision) for coefficient in coefficients])
        halves = [(f"{x}{2 ** (j - 1)}" if j > 1 else x, f"{x}{2**j}") for j in range(1, degree.bit_length())]
        values[f"{name}_powers"] = "".join(f", {power} = {half} * {half}" for half, power in halves)
    return values


def _polynomial(x: str, coefficients: list[str]) -> str:
    """Estrin's scheme, whose halves are independent; x2, x4, ... are the powers of x."""
    if len(coefficients) == 1:
        return coefficients[0]
    power = 2 ** ((len(coefficients) - 1).bit_length() - 1)
    high, low = _polynomial(x, coefficients[power:]), _polynomial(x, coefficients[:power])
    return f"MULTIPLY_ADD({x}{power if power > 1 else ''}, {high}, {low})"
