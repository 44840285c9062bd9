"""Elementary functions in exported C: plain C99 without branches or tables, so that compilers vectorise them.

A source compiled with -DDLN_OWN_ELEMENTARY uses these functions; otherwise it calls <math.h>. They are faster with
vector instructions (-march=native), and slower than the C library without.

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

from collections.abc import Iterable

from dln_jax.export.c.text import fill

OPERATIONS = {"exp": 32, "expm1": 39, "tanh": 51, "sin": 43, "cos": 43, "log": 31, "log1p": 36}
"""Floating-point operations of one evaluation; a multiply-add counts 2, comparisons 0 (float needs fewer)."""
VECTORISED = tuple(OPERATIONS)
"""Names of the vectorising functions."""

# The polynomials are interpolated at Chebyshev nodes in 60 digits (mpmath), then rounded, and evaluated by Estrin's
# scheme, whose halves are independent. In r or in z = r²:
#   exp  (e^r - 1 - r) / r², |r| <= ln(2)/2           sin, cos  (sin(r)/r - 1) / r², ((cos(r) - 1) / r² + 1/2) / r²
#   log  (2 artanh(r)/r - 2) / r², r <= 3 - 2 sqrt(2) tanh      (tanh(r)/r - 1) / r² = tanh / tanh_below, r <= 0.56
# ln 2 and pi/2 have parts: all but the last are short enough for exact products with any n that occurs.
_CONSTANTS = {
    "f64": """
typedef uint64_t elementary_word;
#define elementary_exact FLT_EVAL_METHOD == 0 || FLT_EVAL_METHOD == 1 /* 1: float is computed in double */
#define elementary_mantissa 52
#define elementary_exponent_bits 11
#define elementary_bias 1023
#define elementary_to_sign 62 /* from the bit of 2 */
#define elementary_sign 0x8000000000000000ULL
#define elementary_one 0x3ff0000000000000ULL
#define elementary_root_half 0x3fe6a09e667f3bcdULL
#define elementary_magic 6755399441055744.0 /* 1.5 2^52 */
#define elementary_log2e 1.4426950408889634
#define elementary_ln2_high 0.6931471805598903
#define elementary_ln2_low 5.497923018708371e-14
#define elementary_exp_smallest -708.3964185322641 /* of a normal number */
#define elementary_exp_largest 709.782712893384
#define elementary_bound 2e5 /* of |x|, for the digits of pi */
#define elementary_two_over_pi 0.6366197723675814
#define elementary_head(n, a) MULTIPLY_ADD(-n, 1.5707963267923333, a)
#define elementary_next_part 2.5633441515839558e-12
#define elementary_last_part 1.0562999066987428e-23
#define elementary_smallest 2.2250738585072014e-308
#define elementary_growth 1.8014398509481984e+16 /* 2^54 makes a subnormal number normal */
#define elementary_counting 0x4330000000000000ULL /* bits of 2^52, whose low bits count */
#define elementary_counted_bias 4503599627371519.0 /* 2^52 + 1023 */
#define elementary_square(x) ((x) * (x))
#define elementary_cubic(x, a, b, c, d) \\
    MULTIPLY_ADD(elementary_square(x), MULTIPLY_ADD(x, d, c), MULTIPLY_ADD(x, b, a))
#define elementary_exp_tail(r) \\
    MULTIPLY_ADD(elementary_square(elementary_square(elementary_square(r))), \\
        MULTIPLY_ADD(r, 2.5100472505694996e-08, 2.7620201591031547e-07), \\
        MULTIPLY_ADD(elementary_square(elementary_square(r)), \\
            elementary_cubic(r, 0.0013888888917367081, 0.00019841269863171557, 2.4801521057868204e-05, \\
                2.7557268276905696e-06), \\
            elementary_cubic(r, 0.5000000000000001, 0.16666666666666669, 0.041666666666623824, 0.008333333333330039)))
#define elementary_tanh_above(z) \\
    MULTIPLY_ADD(elementary_square(z), -0.00019930065261747755, \\
        MULTIPLY_ADD(z, -0.020501566345638482, -0.3333333333333333))
#define elementary_tanh_below(z) \\
    elementary_cubic(z, 1.0, 0.46150469903691427, 0.023295019667899867, 0.00020666505951855979)
#define elementary_sin_tail(z) \\
    MULTIPLY_ADD(elementary_square(elementary_square(z)), \\
        MULTIPLY_ADD(z, 1.5917848524808262e-10, -2.5051127944014188e-08), \\
        elementary_cubic(z, -0.16666666666666666, 0.008333333333330925, -0.00019841269836722418, \\
            2.755731608381636e-06))
#define elementary_cos_tail(z) \\
    MULTIPLY_ADD(elementary_square(elementary_square(z)), \\
        MULTIPLY_ADD(z, -1.1382456778061306e-11, 2.0876143827993133e-09), \\
        elementary_cubic(z, 0.041666666666666664, -0.0013888888888887382, 2.480158729874307e-05, \\
            -2.7557317260008837e-07))
#define elementary_log_tail(z) \\
    MULTIPLY_ADD(elementary_square(elementary_square(z)), \\
        MULTIPLY_ADD(elementary_square(z), 0.1461916613488797, \\
            MULTIPLY_ADD(z, 0.1533150161114533, 0.18182895750119193)), \\
        elementary_cubic(z, 0.666666666666667, 0.3999999999989827, 0.2857142862653362, 0.22222211043776857))
""",
    "f32": """
typedef uint32_t elementary_word;
#define elementary_exact FLT_EVAL_METHOD == 0
#define elementary_mantissa 23
#define elementary_exponent_bits 8
#define elementary_bias 127
#define elementary_to_sign 30 /* from the bit of 2 */
#define elementary_sign 0x80000000U
#define elementary_one 0x3f800000U
#define elementary_root_half 0x3f3504f3U
#define elementary_magic 1.2582912e+07f /* 1.5 2^23 */
#define elementary_log2e 1.442695f
#define elementary_ln2_high 0.69314575f
#define elementary_ln2_low 1.4286068e-06f
#define elementary_exp_smallest -87.33654f /* of a normal number */
#define elementary_exp_largest 88.72283f
#define elementary_bound 1e4f /* of |x|, for the digits of pi */
#define elementary_two_over_pi 0.63661975f
#define elementary_head(n, a) MULTIPLY_ADD(-n, 0.0004837513f, MULTIPLY_ADD(-n, 1.5703125f, a))
#define elementary_next_part 7.5495336e-08f
#define elementary_last_part 2.563344e-12f
#define elementary_smallest 1.1754944e-38f
#define elementary_growth 3.3554432e+07f /* 2^25 makes a subnormal number normal */
#define elementary_counting 0x4b000000U /* bits of 2^23, whose low bits count */
#define elementary_counted_bias 8.388735e+06f /* 2^23 + 127 */
#define elementary_square(x) ((x) * (x))
#define elementary_exp_tail(r) \\
    MULTIPLY_ADD(elementary_square(elementary_square(r)), MULTIPLY_ADD(r, 0.0001989108f, 0.0013933731f), \\
        MULTIPLY_ADD(elementary_square(r), MULTIPLY_ADD(r, 0.0083333105f, 0.041666463f), \\
            MULTIPLY_ADD(r, 0.16666667f, 0.5f)))
#define elementary_tanh_above(z) MULTIPLY_ADD(z, -0.0015581064f, -0.3333333f)
#define elementary_tanh_below(z) MULTIPLY_ADD(z, 0.40467018f, 1.0f)
#define elementary_sin_tail(z) \\
    MULTIPLY_ADD(elementary_square(z), MULTIPLY_ADD(z, 2.7249314e-06f, -0.00019840083f), \\
        MULTIPLY_ADD(z, 0.008333332f, -0.16666667f))
#define elementary_cos_tail(z) \\
    MULTIPLY_ADD(elementary_square(z), 2.4547437e-05f, MULTIPLY_ADD(z, -0.00138883f, 0.041666664f))
#define elementary_log_tail(z) \\
    MULTIPLY_ADD(elementary_square(z), 0.29582024f, MULTIPLY_ADD(z, 0.39988735f, 0.66666687f))
""",
}
# Selections use bits: gcc moves code that only one side of ?: needs into a branch, and then cannot vectorise.
_COMMON = """
/* The bits of a number and back, and condition ? x : y without a branch */
typedef union { real number; elementary_word word; } elementary_union;
static inline elementary_word elementary_word_of(real x) { elementary_union u; u.number = x; return u.word; }
static inline real elementary_number_of(elementary_word w) { elementary_union u; u.word = w; return u.number; }
static inline real elementary_choice(int condition, real x, real y)
{
    const elementary_word a = elementary_word_of(x), b = elementary_word_of(y), mask = 0 - (elementary_word)condition;
    return elementary_number_of(b ^ ((a ^ b) & mask));
}
"""
_BITS = {
    "choice": "",
    # The nearest number with fewer bits, ties to even, as XLA rounds it: underflow to zero, overflow to infinity.
    "rounded": """
static inline real elementary_rounded(real x, int exponent_bits, int mantissa_bits)
{
    const elementary_word bits = elementary_word_of(x), sign = bits & elementary_sign, unit = 1;
    const elementary_word last = unit << (elementary_mantissa - mantissa_bits);
    const elementary_word range = (unit << (exponent_bits - 1)) - 1;
    const elementary_word below = ((bits / last) & 1) + last / 2, size = (bits ^ sign) + (below ? below - 1 : 0);
    const elementary_word kept = size & ~(last - 1), exponent = kept >> elementary_mantissa;
    if (x != x) return x;
    if (exponent_bits == elementary_exponent_bits) return elementary_number_of(sign | kept);
    if (exponent > elementary_bias + range) return x < 0 ? -(real)INFINITY : (real)INFINITY;
    if (exponent <= elementary_bias - range) return elementary_number_of(sign);
    return elementary_number_of(sign | kept);
}
""",
    # Integers in the total order of the real numbers: -0 before 0, NaN of either sign outside the infinities.
    "ordered": """
static inline elementary_word elementary_ordered(real x)
{
    const elementary_word bits = elementary_word_of(x);
    return bits & elementary_sign ? ~bits : bits | elementary_sign;
}
""",
}
_EVALUATED = """
#if defined(FLT_EVAL_METHOD) && !(elementary_exact)
#error "FLT_EVAL_METHOD: extended precision makes exp and others wrong; give -mfpmath=sse -msse2, or no \\
-DDLN_OWN_ELEMENTARY"
#endif
"""
# t = n ln 2 + r
_REDUCED = """
    const real shifted = MULTIPLY_ADD(t, elementary_log2e, elementary_magic), n = shifted - elementary_magic;
    const real head = MULTIPLY_ADD(-n, elementary_ln2_high, t), tail = n * elementary_ln2_low, r = head - tail;"""
_QUADRANT = """
    const real a = fabs${f}(x), shifted = MULTIPLY_ADD(a, elementary_two_over_pi, elementary_magic);
    const real n = shifted - elementary_magic, head = elementary_head(n, a);
    const real middle = MULTIPLY_ADD(-n, elementary_next_part, head);
    const real lost = MULTIPLY_ADD(-n, elementary_next_part, head - middle);
    const real r = middle - MULTIPLY_ADD(n, elementary_last_part, -lost), z = r * r;
    const real sine = MULTIPLY_ADD(r * z, elementary_sin_tail(z), r);
    const real cosine = MULTIPLY_ADD(z, MULTIPLY_ADD(z, elementary_cos_tail(z), -(real)0.5), 1);"""
# y = 2ᵏ f for a positive normal number
_SCALED = """
    const elementary_word centred = elementary_word_of(y) + (elementary_one - elementary_root_half);
    const elementary_word exponent = centred >> elementary_mantissa, unit = 1;
    const elementary_word fraction = (centred & ((unit << elementary_mantissa) - 1)) + elementary_root_half;
    const elementary_word counted = exponent | elementary_counting;
    const real f = elementary_number_of(fraction);"""
# log(y) = k ln 2 + log(1 + s)
_LOGARITHM = """
    const real u = s / (2 + s), z = u * u, half_square = (real)0.5 * s * s;
    const real tail = MULTIPLY_ADD(u, MULTIPLY_ADD(z, elementary_log_tail(z), half_square), k * elementary_ln2_low);
    const real value = MULTIPLY_ADD(k, elementary_ln2_high, s) - (half_square - tail);
    const real not_zero = elementary_choice(y == 0, -(real)INFINITY, value);
    const real not_negative = elementary_choice(y < 0, (real)NAN, not_zero);
    const real result = elementary_choice(y < (real)INFINITY, not_negative, x);"""
_WITHIN = """
static inline real elementary_$name(real x)
{
    return fabs${f}(x) <= elementary_bound ? elementary_${name}_within(x) : $name${f}(x);
}
"""
_OWN = {
    "exp": f"""
static inline real elementary_exp(real x)
{{
    const real t = x, above = x + (real)INFINITY;{_REDUCED}
    const real power = 1 + MULTIPLY_ADD(r * r, elementary_exp_tail(r), r);
    const elementary_word shift = elementary_word_of(shifted) << elementary_mantissa;
    const real scaled = elementary_number_of(elementary_word_of(power) + shift);
    const real value = elementary_choice(x <= elementary_exp_largest, scaled, above);
    return elementary_choice(x < elementary_exp_smallest, 0, value);
}}
""",
    "expm1": f"""
static inline real elementary_expm1(real x)
{{
    const real t = x, above = x + (real)INFINITY, half = (real)0.5;{_REDUCED}
    const elementary_word shift = elementary_word_of(shifted) << elementary_mantissa;
    const real scale = elementary_number_of(shift + elementary_word_of(half));
    const real rest = MULTIPLY_ADD(r * r, elementary_exp_tail(r), (head - r) - tail);
    const real value = 2 * MULTIPLY_ADD(scale, rest, MULTIPLY_ADD(scale, r, scale - half));
    const real bounded = elementary_choice(x <= elementary_exp_largest, value, above);
    return copysign${{f}}(elementary_choice(x < -40, -1, bounded), x);
}}
""",
    "tanh": f"""
static inline real elementary_tanh(real x)
{{
    const real size = fabs${{f}}(x), a = elementary_choice(size > 20, 20, size), t = -2 * a;{_REDUCED}
    const elementary_word shift = elementary_word_of(shifted) << elementary_mantissa;
    const real scale = elementary_number_of(shift + elementary_one), z = a * a;
    const real e = MULTIPLY_ADD(scale, MULTIPLY_ADD(r * r, elementary_exp_tail(r), r), scale);
    const real small = a * z * elementary_tanh_above(z), small_below = elementary_tanh_below(z);
    const real large = -2 * e, large_below = 1 + e;
    const int near = a < (real)0.55;
    const real numerator = elementary_choice(near, small, large);
    const real denominator = elementary_choice(near, small_below, large_below);
    return copysign${{f}}(elementary_choice(near, a, 1) + numerator / denominator, x);
}}
""",
    "sin": f"""
static inline real elementary_sin_within(real x)
{{{_QUADRANT}
    const elementary_word quadrant = elementary_word_of(shifted), odd = elementary_word_of(x) & elementary_sign;
    const elementary_word value = elementary_word_of(elementary_choice((int)(quadrant & 1), cosine, sine));
    return elementary_number_of(value ^ ((quadrant & 2) << elementary_to_sign) ^ odd);
}}
{_WITHIN}""",
    "cos": f"""
static inline real elementary_cos_within(real x)
{{{_QUADRANT}
    const elementary_word quadrant = elementary_word_of(shifted) + 1;
    const elementary_word value = elementary_word_of(elementary_choice((int)(quadrant & 1), cosine, sine));
    return elementary_number_of(value ^ ((quadrant & 2) << elementary_to_sign));
}}
{_WITHIN}""",
    "log": f"""
static inline real elementary_log(real x)
{{
    const int tiny = x < elementary_smallest;
    const real grown = x * elementary_growth, y = elementary_choice(tiny, grown, x);{_SCALED}
    const real grown_bias = elementary_counted_bias + (elementary_mantissa + 2);
    const real bias = elementary_choice(tiny, grown_bias, elementary_counted_bias);
    const real k = elementary_number_of(counted) - bias, s = f - 1;{_LOGARITHM}
    return result;
}}
""",
    # The rounding error of 1 + x joins s, times 2⁻ᵏ: by halves, since 2⁻ᵏ may be subnormal.
    "log1p": f"""
static inline real elementary_log1p(real x)
{{
    const real y = 1 + x, lost = x - (y - 1);{_SCALED}
    const elementary_word twice_inverse_power = (2 * elementary_bias + 1 - exponent) << elementary_mantissa;
    const real k = elementary_number_of(counted) - elementary_counted_bias;
    const real s = (f - 1) + (real)0.5 * lost * elementary_number_of(twice_inverse_power);{_LOGARITHM}
    return copysign${{f}}(result, x);
}}
""",
    "sin_cos": f"""
static inline void elementary_sin_cos(real x, real *sine_of_x, real *cosine_of_x)
{{
    if (!(fabs${{f}}(x) <= elementary_bound)) {{
        *sine_of_x = sin${{f}}(x);
        *cosine_of_x = cos${{f}}(x);
        return;
    }}{_QUADRANT}
    const elementary_word quadrant = elementary_word_of(shifted), odd = elementary_word_of(x) & elementary_sign;
    const elementary_word first = elementary_word_of(elementary_choice((int)(quadrant & 1), cosine, sine));
    const elementary_word second = elementary_word_of(elementary_choice((int)(quadrant & 1), sine, cosine));
    *sine_of_x = elementary_number_of(first ^ ((quadrant & 2) << elementary_to_sign) ^ odd);
    *cosine_of_x = elementary_number_of(second ^ (((quadrant + 1) & 2) << elementary_to_sign));
}}
""",
}
_BOUNDED_EACH = """
static void elementary_${name}_each(int n, const real *RESTRICT x, real *RESTRICT y)
{
    int beyond = 0;
    for (int i = 0; i < n; ++i) {
        y[i] = elementary_${name}_within(x[i]);
        beyond |= !(fabs${f}(x[i]) <= elementary_bound);
    }
    for (int i = 0; beyond && i < n; ++i) y[i] = elementary_$name(x[i]);
}
"""
_EACH = """
static void elementary_${name}_each(int n, const real *RESTRICT x, real *RESTRICT y)
{
    for (int i = 0; i < n; ++i) y[i] = elementary_$name(x[i]);
}
"""
_OF_LIBRARY = "#define elementary_$name(x) $name${f}(x)\n"
_BOTH_OF_LIBRARY = """static inline void elementary_sin_cos(real x, real *sine_of_x, real *cosine_of_x)
{
    *sine_of_x = sin${f}(x);
    *cosine_of_x = cos${f}(x);
}
"""


def definitions(names: Iterable[str], precision: str, *, arrays: Iterable[str] = ()) -> str:
    """Returns the C text of `elementary_NAME(x)`, of `elementary_NAME_each(n, x, y)` for arrays, and of helpers.

    Special names: `choice` selects one of two numbers (the others use it); `rounded` rounds to fewer bits; `ordered`
    compares in the total order; `sin_cos` computes both functions in the time of one.

    The source must first include <float.h>, <math.h> and <stdint.h> and define the type `real` and `MULTIPLY_ADD(a, b,
    c)`, which is a b + c, fused or not. Arrays have separate functions: gcc vectorises the loop around a call only if
    it inlines the call, and it inlines about sixty calls per source.
    """
    arrays = set(arrays)
    needed = arrays.union(names)
    bits = [text for name, text in _BITS.items() if name in needed]
    helpers = _CONSTANTS[precision] + _COMMON
    own = library = ""
    for name in (name for name in _OWN if name in needed):
        of_library = _BOTH_OF_LIBRARY if name == "sin_cos" else _OF_LIBRARY
        loop = _BOUNDED_EACH if name in ("sin", "cos") else _EACH
        own += fill(_OWN[name] + loop * (name in arrays), precision, name=name)
        library += fill(of_library + _EACH * (name in arrays), precision, name=name)
    if own:  # compilers warn about functions that nothing calls
        own = f"\n#ifdef DLN_OWN_ELEMENTARY{helpers * (not bits)}{_EVALUATED}{own}\n#else\n{library}#endif\n"
    return "".join([helpers * bool(bits), *bits, own])
