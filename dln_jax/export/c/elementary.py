"""Elementary functions in exported C: plain C99 without branches or tables, which compilers vectorise.

Each is accurate to two units in the last place over its range and has the usual values at zeros, infinities and NaN;
only `exp` flushes results below the smallest normal number to zero. The methods are standard (Cody and Waite, Software
Manual for the Elementary Functions, 1980; Muller, Elementary Functions, 2016):

    exp, expm1  x = n ln 2 + r, a polynomial in r, 2ⁿ by its bits
    tanh        1 - 2 e / (1 + e) with e = exp(-2|x|); near 0 a rational function; one division serves both
    sin, cos    |x| = n pi/2 + r, with pi/2 in parts whose products with n are exact; n selects a polynomial
    log, log1p  x = 2ᵏ (1 + s), log(1 + s) = 2 artanh(s / (2 + s))

A number is rounded to an integer n by adding 1.5 2⁵² (float: 1.5 2²³), which leaves n in the low bits of the sum. This
needs IEEE round-to-nearest arithmetic, so no -ffast-math.
"""

import re
from collections.abc import Iterable, Mapping
from textwrap import TextWrapper

from dln_jax.export.c.elementary_constants import values_of
from dln_jax.export.c.text import fill, number

BOUNDS: Mapping[str, Mapping[str, float]] = {name: {"f64": 2e5, "f32": 1e4} for name in ("sin", "cos")}
"""Largest |x| for which the stored digits of pi suffice; beyond it C calls <math.h>. Other functions have no bound."""

# Selections use bits: gcc moves code that only one side of ?: needs into a branch, and then cannot vectorise.
_COMMON = """
/* Elementary functions: the bits of a number and back, and condition ? x : y without a branch */
typedef $word elementary_word;
typedef union { real number; elementary_word word; } elementary_union;
static inline elementary_word elementary_word_of(real x) { elementary_union u; u.number = x; return u.word; }
static inline real elementary_number_of(elementary_word w) { elementary_union u; u.word = w; return u.number; }
static inline real elementary_choice(int condition, real x, real y)
{
    const elementary_word a = elementary_word_of(x), b = elementary_word_of(y), mask = 0 - (elementary_word)condition;
    return elementary_number_of(b ^ ((a ^ b) & mask));
}
"""
_EVALUATION = """
#if defined(FLT_EVAL_METHOD) && FLT_EVAL_METHOD != 0$or_double
#error "FLT_EVAL_METHOD: extended precision makes exp and others wrong; give -mfpmath=sse -msse2, or export with --libm"
#endif
"""
# The nearest number with fewer bits, ties to even, as XLA rounds it: underflow to zero, overflow to infinity.
_ROUNDED = """static inline real elementary_rounded(real x, int exponent_bits, int mantissa_bits)
{
    const elementary_word bits = elementary_word_of(x), sign = bits & $sign, unit = 1;
    const elementary_word last = unit << ($mantissa - mantissa_bits), range = (unit << (exponent_bits - 1)) - 1;
    const elementary_word below = ((bits / last) & 1) + last / 2, size = (bits ^ sign) + (below ? below - 1 : 0);
    const elementary_word kept = size & ~(last - 1), exponent = kept >> $mantissa;
    if (x != x) return x;
    if (exponent_bits == $exponent_bits) return elementary_number_of(sign | kept);
    if (exponent > $bias_of_exponent + range) return x < 0 ? -(real)INFINITY : (real)INFINITY;
    if (exponent <= $bias_of_exponent - range) return elementary_number_of(sign);
    return elementary_number_of(sign | kept);
}
"""
# Integers in the total order of the real numbers: -0 before 0, NaN of either sign outside the infinities.
_ORDERED = """static inline elementary_word elementary_ordered(real x)
{
    const elementary_word bits = elementary_word_of(x);
    return bits & $sign ? ~bits : bits | $sign;
}
"""
_BOUNDED = """static inline real elementary_$name(real x)
{
    return fabs${f}(x) <= $bound ? elementary_${name}_within(x) : $name${f}(x);
}
"""
_EACH = """static void elementary_${name}_each(int n, const real *RESTRICT x, real *RESTRICT y)
{
    for (int i = 0; i < n; ++i) y[i] = elementary_$name(x[i]);
}
"""
_EACH_BOUNDED = """static void elementary_${name}_each(int n, const real *RESTRICT x, real *RESTRICT y)
{
    int beyond = 0;
    for (int i = 0; i < n; ++i) {
        y[i] = elementary_${name}_within(x[i]);
        beyond |= !(fabs${f}(x[i]) <= $bound);
    }
    for (int i = 0; beyond && i < n; ++i) y[i] = elementary_$name(x[i]);
}
"""
# t = n ln 2 + r
_REDUCED = """
const real shifted = MULTIPLY_ADD(t, $log2e, $magic), n = shifted - $magic;
const real head = MULTIPLY_ADD(-n, $ln2_high, t), tail = n * $ln2_low, r = head - tail$exp_powers;
"""
_QUADRANT = """
const real a = fabs${f}(x), shifted = MULTIPLY_ADD(a, $two_over_pi, $magic), n = shifted - $magic;
const real head = $head, middle = MULTIPLY_ADD(-n, $next_part, head);
const real lost = MULTIPLY_ADD(-n, $next_part, head - middle), r = middle - MULTIPLY_ADD(n, $last_part, -lost);
const real z = r * r$sin_powers;
const real sine = MULTIPLY_ADD(r * z, $sin, r), cosine = MULTIPLY_ADD(z, MULTIPLY_ADD(z, $cos, -$half), 1);
"""
_QUARTER = """const elementary_word quadrant = elementary_word_of(shifted) + QUARTER, odd = elementary_word_of(x) & ODD;
const elementary_word value = elementary_word_of(elementary_choice((int)(quadrant & 1), cosine, sine));
return elementary_number_of(value ^ ((quadrant & 2) << $to_sign) ^ odd);
"""
_BOTH = """const elementary_word quadrant = elementary_word_of(shifted), odd = elementary_word_of(x) & $sign;
const elementary_word first = elementary_word_of(elementary_choice((int)(quadrant & 1), cosine, sine));
const elementary_word second = elementary_word_of(elementary_choice((int)(quadrant & 1), sine, cosine));
*sine_of_x = elementary_number_of(first ^ ((quadrant & 2) << $to_sign) ^ odd);
*cosine_of_x = elementary_number_of(second ^ (((quadrant + 1) & 2) << $to_sign));
"""
_SIN_COS = """static inline void elementary_sin_cos(real x, real *sine_of_x, real *cosine_of_x)
{
    if (!(fabs${f}(x) <= $bound)) {
        *sine_of_x = sin${f}(x);
        *cosine_of_x = cos${f}(x);
        return;
    }
BODY
}
"""
# y = 2ᵏ f for a positive normal number
_SCALED = """
const elementary_word centred = elementary_word_of(y) + ($one - $root_half), exponent = centred >> $mantissa;
const elementary_word fraction = (centred & $fraction_mask) + $root_half, counted = exponent | $counting;
const real f = elementary_number_of(fraction);
"""
# log(y) = k ln 2 + log(1 + s)
_LOGARITHM = """
const real u = s / (2 + s), z = u * u, half_square = $half * s * s$log_powers;
const real tail = MULTIPLY_ADD(u, MULTIPLY_ADD(z, $log, half_square), k * $ln2_low);
const real value = MULTIPLY_ADD(k, $ln2_high, s) - (half_square - tail);
const real not_zero = elementary_choice(y == 0, -(real)INFINITY, value);
const real not_negative = elementary_choice(y < 0, (real)NAN, not_zero);
const real result = elementary_choice(y < (real)INFINITY, not_negative, x);
"""
# Integer arithmetic stands in lines of `elementary_word`: `OPERATIONS` counts the others.
_BODIES = {
    "exp": f"""const real t = x, above = x + (real)INFINITY;{_REDUCED}
const real power = 1 + MULTIPLY_ADD(r2, $exp, r);
const elementary_word scaled = elementary_word_of(power) + (elementary_word_of(shifted) << $mantissa);
const real value = elementary_choice(x <= $exp_largest, elementary_number_of(scaled), above);
return elementary_choice(x < $exp_smallest, 0, value);
""",
    "expm1": f"""const real t = x, above = x + (real)INFINITY;{_REDUCED}
const elementary_word half_power = (elementary_word_of(shifted) << $mantissa) + $one_half;
const real scale = elementary_number_of(half_power), rest = MULTIPLY_ADD(r2, $exp, (head - r) - tail);
const real value = 2 * MULTIPLY_ADD(scale, rest, MULTIPLY_ADD(scale, r, scale - $half));
const real bounded = elementary_choice(x <= $exp_largest, value, above);
return copysign${{f}}(elementary_choice(x < -40, -1, bounded), x);
""",
    "tanh": f"""const real size = fabs${{f}}(x), a = elementary_choice(size > 20, 20, size), t = -2 * a;{_REDUCED}
const elementary_word power = (elementary_word_of(shifted) << $mantissa) + $one;
const real scale = elementary_number_of(power), e = MULTIPLY_ADD(scale, MULTIPLY_ADD(r2, $exp, r), scale);
const real z = a * a$tanh_below_powers;
const real small = a * z * $tanh, small_below = $tanh_below, large = -2 * e, large_below = 1 + e;
const real numerator = elementary_choice(a < $split, small, large);
const real denominator = elementary_choice(a < $split, small_below, large_below);
return copysign${{f}}(elementary_choice(a < $split, a, 1) + numerator / denominator, x);
""",
    "sin": _QUADRANT + _QUARTER.replace("QUARTER", "0").replace("ODD", "$sign"),
    "cos": _QUADRANT + _QUARTER.replace("QUARTER", "1").replace("ODD", "0"),
    "log": f"""const real grown = x * $growth, y = elementary_choice(x < $smallest, grown, x);{_SCALED}
const real bias = elementary_choice(x < $smallest, $grown_bias, $bias), k = elementary_number_of(counted) - bias;
const real s = f - 1;{_LOGARITHM}
return result;
""",
    # The rounding error of 1 + x joins s, times 2⁻ᵏ: by halves, since 2⁻ᵏ may be subnormal.
    "log1p": f"""const real y = 1 + x, lost = x - (y - 1);{_SCALED}
const elementary_word twice_inverse_power = ($exponent_mask - exponent) << $mantissa;
const real k = elementary_number_of(counted) - $bias, scale = elementary_number_of(twice_inverse_power);
const real s = (f - 1) + $half * lost * scale;{_LOGARITHM}
return copysign${{f}}(result, x);
""",
}
_wrapper = TextWrapper(116, initial_indent="    ", subsequent_indent="        ", break_on_hyphens=False)
VECTORISED: tuple[str, ...] = tuple(_BODIES)
"""Names of the functions that vectorise."""


def definitions(names: Iterable[str], precision: str, *, arrays: Iterable[str] = ()) -> str:
    """Returns the C of `elementary_NAME(x)` for names, of `elementary_NAME_each(n, x, y)` for arrays, and of helpers.

    Special names: `choice` selects one of two numbers, which the others need too; `rounded` rounds to fewer bits;
    `ordered` compares in the total order; `sin_cos` computes both functions in the time of one.

    The source must first include <float.h>, <math.h> and <stdint.h> and define the type `real` and
    `MULTIPLY_ADD(a, b, c)`, which is a b + c, fused or not. Arrays have functions of their own because gcc vectorises
    the loop around a call only if it inlines the call, and it inlines about sixty calls per source.
    """
    arrays = set(arrays)
    needed = set(names) | arrays
    chosen = needed & {*VECTORISED, "sin_cos"}
    if not chosen and not needed & {"choice", "rounded", "ordered"}:
        return ""  # clang warns about unused functions
    facts = values_of(precision)
    # With method 1, float is computed in double, which breaks only the functions of float.
    text = [fill(_EVALUATION, precision, or_double=" && FLT_EVAL_METHOD != 1" * (precision == "f64"))] * bool(chosen)
    text.append(fill(_COMMON, precision, **facts))
    text += [fill(_ROUNDED, precision, **facts)] * ("rounded" in needed)
    text += [fill(_ORDERED, precision, **facts)] * ("ordered" in needed)
    if "sin_cos" in chosen:
        both = _SIN_COS.replace("BODY", _lines(_QUADRANT + _BOTH, precision))
        text.append(fill(both, precision, bound=number(BOUNDS["sin"][precision], precision)))
    for name in (name for name in VECTORISED if name in chosen):
        bounded = name in BOUNDS
        text.append(_function(name, precision, "_within" * bounded))
        facts = {"name": name, "bound": number(BOUNDS[name][precision], precision) if bounded else ""}
        if bounded:
            text.append(fill(_BOUNDED, precision, **facts))
        if name in arrays:
            text.append(fill(_EACH_BOUNDED if bounded else _EACH, precision, **facts))
    return "\n".join(text)


def _function(name: str, precision: str, ending: str = "") -> str:
    return f"static inline real elementary_{name}{ending}(real x)\n{{\n{_lines(_BODIES[name], precision)}\n}}\n"


def _lines(body: str, precision: str) -> str:
    lines = fill(body, precision, **values_of(precision)).splitlines()
    return "\n".join(_wrapper.fill(line) for line in lines if line)


def _operations(name: str) -> int:
    text = re.sub("const elementary_word[^;]*;", "", _function(name, "f64"))
    return 2 * text.count("MULTIPLY_ADD") + len(re.findall(r"\s[-+*/]\s", text))


OPERATIONS: Mapping[str, int] = {name: _operations(name) for name in VECTORISED}
"""Floating-point operations of one evaluation; a multiply-add counts 2, comparisons 0 (float needs fewer)."""
