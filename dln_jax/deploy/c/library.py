"""Helper functions of exported C: products with tables, solves, and scalar functions.

Helpers carry their sizes in their names (`combine_4_64`), so that a compiler knows every loop count, and a source
holds those that it calls and no others. Loops vectorise without reordering sums: either the innermost loop runs over
the results, or a sum is kept in several parts.
"""

import re

from dln_jax.deploy.c.activations import activate
from dln_jax.deploy.c.text import fill

_BLOCK = {"f32": (32, 16, 8), "f64": (16, 8)}
"""Results that are summed side by side; they fit the vector registers."""
_PARTS = {"f32": 16, "f64": 8}
"""Partial sums of a dot product."""

_COMBINE = """
/* y[$columns] = bias + sum_r x[r] table[r][:] */
static void combine_${rows}_$columns(const real *restrict table, const real *restrict bias, const real *restrict x,
                       real *restrict y)
{
    for (int c = 0; c < $columns; c += $block) {
        real sum[$block];
        for (int k = 0; k < $block; ++k) sum[k] = bias[c + k];
        for (int r = 0; r < $rows; ++r)
            for (int k = 0; k < $block; ++k) sum[k] += x[r] * table[r * $columns + c + k];
        for (int k = 0; k < $block; ++k) y[c + k] = sum[k];
    }
}
"""
_COMBINE_RATES = """
/* y[$columns] = bias + sum_r x[r] table[r][:], and its rate sum_r x_rate[r] table[r][:], in one pass. */
static void combine_rates_${rows}_$columns(const real *restrict table, const real *restrict bias,
                             const real *restrict x, const real *restrict x_rate,
                             real *restrict y, real *restrict y_rate)
{
    for (int c = 0; c < $columns; c += $block) {
        real sum[$block], rate[$block];
        for (int k = 0; k < $block; ++k) sum[k] = bias[c + k];
        for (int k = 0; k < $block; ++k) rate[k] = 0;
        for (int r = 0; r < $rows; ++r)
            for (int k = 0; k < $block; ++k) {
                sum[k] += x[r] * table[r * $columns + c + k];
                rate[k] += x_rate[r] * table[r * $columns + c + k];
            }
        for (int k = 0; k < $block; ++k) y[c + k] = sum[k];
        for (int k = 0; k < $block; ++k) y_rate[c + k] = rate[k];
    }
}
"""
_PUSH = """
/* y[$columns] = sum_r x[r] table[r][:] */
static void push_${rows}_$columns(const real *restrict table, const real *restrict x, real *restrict y)
{
    for (int c = 0; c < $columns; ++c) y[c] = 0;
    for (int r = 0; r < $rows; ++r)
        for (int c = 0; c < $columns; ++c) y[c] += x[r] * table[r * $columns + c];
}
"""
_DOTS = """
/* y[r] = sum_c table[r][c] x[c], r < $rows */
static void dots_${rows}_$columns(const real *restrict table, const real *restrict x, real *restrict y)
{
"""
_LONG_DOTS = """\
    for (int r = 0; r < $rows; ++r, table += $columns) {
        real part[$parts] = {0}, sum = 0;
        for (int c = 0; c < $whole; c += $parts)
            for (int k = 0; k < $parts; ++k) part[k] += table[c + k] * x[c + k];
        for (int half = $parts / 2; half > 0; half /= 2)
            for (int k = 0; k < half; ++k) part[k] += part[k + half];
        for (int c = $whole; c < $columns; ++c) sum += table[c] * x[c];
        y[r] = part[0] + sum;
    }
}
"""
_SHORT_DOTS = """\
    for (int r = 0; r < $rows; ++r) {
        real sum = 0;
        for (int c = 0; c < $columns; ++c) sum += table[r * $columns + c] * x[c];
        y[r] = sum;
    }
}
"""
_SCALAR = {
    "softplus": """
/* log(1 + e^x) without overflow */
static real softplus(real x)
{
    return (x < 0 ? 0 : x) + log1p${f}(exp${f}(-fabs${f}(x)));
}
""",
    "logistic": """
/* 1 / (1 + e^-x), the slope of softplus */
static real logistic(real x)
{
    const real decay = exp${f}(-fabs${f}(x));
    return (x < 0 ? decay : 1) / (1 + decay);
}
""",
    "solve_lower": """
/* x with L x = b; L lower triangular, row-major */
static void solve_lower(const real *restrict L, const real *restrict b, real *restrict x)
{
    for (int i = 0; i < D; ++i) {
        real rest = b[i];
        for (int j = 0; j < i; ++j) rest -= L[i * D + j] * x[j];
        x[i] = rest / L[i * D + i];
    }
}
""",
    "solve_lower_transposed": """
/* x with L^T x = b; L lower triangular, row-major */
static void solve_lower_transposed(const real *restrict L, const real *restrict b, real *restrict x)
{
    for (int i = D - 1; i >= 0; --i) {
        real rest = b[i];
        for (int j = i + 1; j < D; ++j) rest -= L[j * D + i] * x[j];
        x[i] = rest / L[i * D + i];
    }
}
""",
}
_ELIMINATE = """
/* Replaces b [D, $columns] by x with A x = b, by elimination with partial pivoting; overwrites A [D, D]. */
static void eliminate_$columns(real *restrict A, real *restrict b)
{
    for (int k = 0; k < D; ++k) {
        int pivot = k;
        for (int i = k + 1; i < D; ++i)
            if (fabs${f}(A[i * D + k]) > fabs${f}(A[pivot * D + k])) pivot = i;
        for (int j = 0; j < D; ++j) {
            const real swap = A[k * D + j];
            A[k * D + j] = A[pivot * D + j];
            A[pivot * D + j] = swap;
        }
        for (int j = 0; j < $columns; ++j) {
            const real swap = b[k * $columns + j];
            b[k * $columns + j] = b[pivot * $columns + j];
            b[pivot * $columns + j] = swap;
        }
        for (int i = k + 1; i < D; ++i) {
            const real factor = A[i * D + k] / A[k * D + k];
            for (int j = k + 1; j < D; ++j) A[i * D + j] -= factor * A[k * D + j];
            for (int j = 0; j < $columns; ++j) b[i * $columns + j] -= factor * b[k * $columns + j];
        }
    }
    for (int k = D - 1; k >= 0; --k)
        for (int j = 0; j < $columns; ++j) {
            real rest = b[k * $columns + j];
            for (int i = k + 1; i < D; ++i) rest -= A[k * D + i] * b[i * $columns + j];
            b[k * $columns + j] = rest / A[k * D + k];
        }
}
"""
_TEXTS = {"combine": _COMBINE, "combine_rates": _COMBINE_RATES, "push": _PUSH, "eliminate": _ELIMINATE, **_SCALAR}
_CALL = re.compile(rf"\b(dots|activate(?:_with_slope|_with_curvature)?|{'|'.join(_TEXTS)})((?:_\d+)*)(?=\()")


def helpers(body: str, precision: str, activation: str) -> str:
    """Definitions of the helpers that a body calls."""
    calls = {match[0]: match for match in _CALL.finditer(body)}
    return "".join(_definition(calls[name], precision, activation) for name in sorted(calls))


def _definition(call: re.Match, precision: str, activation: str) -> str:
    rows, columns = ([0, 0] + [int(size) for size in call[2].split("_")[1:]])[-2:]
    if call[1].startswith("activate"):
        return activate(call[1], columns, activation, precision)
    block = next((size for size in _BLOCK[precision] if columns % size == 0), 1)
    parts = _PARTS[precision] if columns % _PARTS[precision] == 0 else 8
    whole = columns // parts * parts
    text = _DOTS + (_LONG_DOTS if whole else _SHORT_DOTS) if call[1] == "dots" else _TEXTS[call[1]]
    return fill(text, precision, rows=rows, columns=columns, block=block, parts=parts, whole=whole)
