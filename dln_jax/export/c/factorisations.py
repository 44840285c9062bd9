"""C of factorisations of small dense matrices, and of triangular solves."""

from collections.abc import Collection, Sequence
from textwrap import dedent

from dln_jax.export.c.body import Body
from dln_jax.export.c.moves import copied
from dln_jax.export.c.nodes import Node

_SWEEPS = 7
"""Jacobi sweeps that the operation count assumes; random matrices of 6 rows need 5 to 7, of 40 rows 8 to 10."""

FUNCTIONS = {
    "cholesky": """
    /* Lower triangular l with l l^T = a [n, n]; all NaN where a is not positive definite */
    static void cholesky(int n, const real *a, real *l)
    {
        int definite = 1; /* a NaN reaches what depends on it */
        for (int i = 0; i < n; ++i)
            for (int j = 0; j < n; ++j) {
                real rest = a[i * n + j];
                if (j > i) {
                    l[i * n + j] = 0;
                    continue;
                }
                for (int k = 0; k < j; ++k) rest -= l[i * n + k] * l[j * n + k];
                l[i * n + j] = i == j ? SQRT(rest) : rest / l[j * n + j];
                definite &= i != j || !(rest <= 0);
            }
        for (int i = 0; !definite && i < n * n; ++i) l[i] = (real)NAN;
    }
    """,
    "triangular_solve": """
    /* x [n, columns] with a x = b, a lower or upper triangular */
    static void triangular_solve(int n, int columns, int lower, int unit, const real *a, const real *b, real *x)
    {
        for (int turn = 0; turn < n; ++turn) {
            const int i = lower ? turn : n - 1 - turn;
            for (int c = 0; c < columns; ++c) {
                real rest = b[i * columns + c];
                for (int j = lower ? 0 : i + 1; j < (lower ? i : n); ++j) rest -= a[i * n + j] * x[j * columns + c];
                x[i * columns + c] = unit ? rest : rest / a[i * n + i];
            }
        }
    }
    """,
    "lu": """
    /* Factors of rows of a [n, m] by elimination with partial pivoting: packed, row exchanged at each step, order */
    static void lu(int n, int m, const real *a, real *packed, int *pivots, int *order)
    {
        for (int i = 0; i < n * m; ++i) packed[i] = a[i];
        for (int i = 0; i < n; ++i) order[i] = i;
        for (int k = 0; k < n && k < m; ++k) {
            int pivot = k;
            for (int i = k + 1; i < n; ++i)
                if (FABS(packed[i * m + k]) > FABS(packed[pivot * m + k])) pivot = i;
            pivots[k] = pivot;
            if (pivot != k) {
                const int moved = order[k];
                order[k] = order[pivot];
                order[pivot] = moved;
                for (int j = 0; j < m; ++j) {
                    const real swapped = packed[k * m + j];
                    packed[k * m + j] = packed[pivot * m + j];
                    packed[pivot * m + j] = swapped;
                }
            }
            for (int i = k + 1; i < n; ++i) {
                packed[i * m + k] /= packed[k * m + k];
                for (int j = k + 1; j < m; ++j) packed[i * m + j] -= packed[i * m + k] * packed[k * m + j];
            }
        }
    }
    """,
    "permutation": """
    /* Order of n rows after row k is exchanged with row pivots[k], for each k in turn */
    static void elementary_permutation(int n, int exchanges, const int32_t *pivots, int32_t *order)
    {
        for (int i = 0; i < n; ++i) order[i] = i;
        for (int k = 0; k < exchanges; ++k) {
            const int32_t moved = order[k], pivot = pivots[k] < 0 ? 0 : pivots[k] < n ? pivots[k] : n - 1;
            order[k] = order[pivot];
            order[pivot] = moved;
        }
    }
    """,
    "geqrf": """
    /* QR factorisation of a [m, n] as LAPACK packs it: R, below it the reflectors I - tau v v^T, then their tau */
    static void elementary_geqrf(int m, int n, const real *a, real *packed)
    {
        for (int i = 0; i < m * n; ++i) packed[i] = a[i];
        for (int k = 0; k < m && k < n; ++k) {
            real *tau = packed + m * n + k, *corner = packed + k * n + k, largest = 0, below = 0;
            for (int i = k + 1; i < m; ++i) {
                const real size = FABS(packed[i * n + k]);
                largest = size > largest ? size : largest;
            }
            for (int i = k + 1; i < m; ++i) { /* scaled, so that no square overflows; a NaN stays one */
                const real scaled = packed[i * n + k] / (largest > 0 ? largest : 1);
                below += scaled * scaled;
            }
            *tau = 0;
            if (below == 0) continue;
            const real rest = largest * SQRT(below), scale = FABS(*corner) > rest ? FABS(*corner) : rest;
            const real length = scale * SQRT((*corner / scale) * (*corner / scale) + (rest / scale) * (rest / scale));
            const real diagonal = *corner < 0 ? length : -length, first = *corner - diagonal;
            *tau = -first / diagonal;
            for (int i = k + 1; i < m; ++i) packed[i * n + k] /= first;
            *corner = diagonal;
            for (int j = k + 1; j < n; ++j) {
                real product = packed[k * n + j];
                for (int i = k + 1; i < m; ++i) product += packed[i * n + k] * packed[i * n + j];
                packed[k * n + j] -= *tau * product;
                for (int i = k + 1; i < m; ++i) packed[i * n + j] -= *tau * product * packed[i * n + k];
            }
        }
    }
    """,
    "householder_product": """
    /* First n columns of the product of k reflectors, which are packed in the columns of a [m, n] */
    static void elementary_householder_product(int m, int n, int k, const real *a, const real *tau, real *q)
    {
        for (int i = 0; i < m * n; ++i) q[i] = i / n == i % n ? (real)1 : 0;
        for (int c = k - 1; c >= 0; --c)
            for (int j = c; j < n; ++j) {
                real product = q[c * n + j];
                for (int i = c + 1; i < m; ++i) product += a[i * n + c] * q[i * n + j];
                q[c * n + j] -= tau[c] * product;
                for (int i = c + 1; i < m; ++i) q[i * n + j] -= tau[c] * product * a[i * n + c];
            }
    }
    """,
    "eigh": """
    /* Eigenvectors of a symmetric matrix as columns [n, n], then ascending eigenvalues [n], by Jacobi's rotations;
       all NaN where an element is not finite, or after 60 sweeps. `left` is a copy of the matrix, which is used up */
    static void elementary_eigh(int n, real *left, real *found)
    {
        real *values = found + n * n;
        int rotated = 1, finite = 1;
        for (int i = 0; i < n * n; ++i) {
            found[i] = i / n == i % n ? (real)1 : 0;
            finite &= left[i] - left[i] == 0;
        }
        for (int sweep = 0; finite && rotated && sweep < 60; ++sweep) {
            rotated = 0;
            for (int p = 0; p < n; ++p)
                for (int q = p + 1; q < n; ++q) {
                    const real x = left[p * n + p], y = left[q * n + q], z = left[p * n + q];
                    if (FABS(x) + FABS(z) == FABS(x) && FABS(y) + FABS(z) == FABS(y)) continue;
                    const real theta = (y / 2 - x / 2) / z, size = FABS(theta);
                    const real tangent = (theta < 0 ? -(real)1 : 1) / (size + SQRT(1 + size * size));
                    const real c = 1 / SQRT(1 + tangent * tangent), s = tangent * c;
                    rotated = 1;
                    for (int i = 0; i < n; ++i) {
                        const real u = found[i * n + p], v = found[i * n + q];
                        found[i * n + p] = c * u - s * v;
                        found[i * n + q] = s * u + c * v;
                        if (i == p || i == q) continue;
                        const real a = left[i * n + p], b = left[i * n + q];
                        left[i * n + p] = left[p * n + i] = c * a - s * b;
                        left[i * n + q] = left[q * n + i] = s * a + c * b;
                    }
                    left[p * n + p] = x - tangent * z;
                    left[q * n + q] = y + tangent * z;
                    left[p * n + q] = left[q * n + p] = 0;
                }
        }
        for (int i = 0; i < n; ++i) values[i] = left[i * n + i];
        for (int k = 0; k < n; ++k) {
            int least = k;
            for (int i = k + 1; i < n; ++i) least = values[i] < values[least] ? i : least;
            const real moved = values[k];
            values[k] = values[least];
            values[least] = moved;
            for (int i = 0; i < n && least != k; ++i) {
                const real swapped = found[i * n + k];
                found[i * n + k] = found[i * n + least];
                found[i * n + least] = swapped;
            }
        }
        for (int i = 0; (rotated || !finite) && i < n * n + n; ++i) found[i] = (real)NAN;
    }
    """,
}
"""C functions by the name of their node; a source contains those that it calls."""


def definitions(names: Collection[str], suffix: str) -> str:
    """Returns the C text of the named functions."""
    text = "".join("\n" + dedent(FUNCTIONS[name]).strip() + "\n" for name in FUNCTIONS if name in names)
    return text.replace("SQRT(", f"sqrt{suffix}(").replace("FABS(", f"fabs{suffix}(")


def _call(body: Body, node: Node, sizes: Sequence[int], operations: int = 0) -> None:
    """Writes a call of the node's C function with sizes, pointers to the arguments, and the array for the result."""
    body.source.kernels.add(node.op)
    target = body.kept(node)
    prefix = "" if node.op in ("cholesky", "triangular_solve") else "elementary_"
    arguments = [*map(str, sizes), *map(body.pointer, node.args), target]
    body.line(f"{prefix}{node.op}({', '.join(arguments)});")
    body.spend(operations)


def _cholesky(body: Body, node: Node) -> None:
    n, _ = node.shape
    _call(body, node, [n], n * (n + 1) * (n + 2) // 3)


def _triangular_solve(body: Body, node: Node) -> None:
    n, columns = node.shape
    _call(body, node, [n, columns, *map(int, node.attribute)], n * n * columns)


def _lu(body: Body, node: Node) -> None:
    (a,) = node.args
    n, m = a.shape
    body.source.kernels.add("lu")
    names = [f"v{node.number}_{part}" for part in range(3)]
    for name, dtype, size in zip(names, ("real", "int", "int"), (n * m, min(n, m), n), strict=True):
        body.declared(name, dtype, size)
    body.line(f"lu({n}, {m}, {body.pointer(a)}, {', '.join(names)});")
    body.spend(2 * n * n * m // 3)


def _permutation(body: Body, node: Node) -> None:
    _call(body, node, [node.size, node.args[0].size])


def _geqrf(body: Body, node: Node) -> None:
    m, n = node.args[0].shape
    _call(body, node, [m, n], 2 * m * n * min(m, n))


def _householder_product(body: Body, node: Node) -> None:
    (m, n), k = node.shape, node.args[1].size
    _call(body, node, [m, n, k], 2 * m * n * k)


def _eigh(body: Body, node: Node) -> None:
    (a,) = node.args
    n, left = a.shape[0], f"v{node.number}_left"
    body.source.kernels.add("eigh")
    body.declared(left, "real", n * n)
    copied(body, a, left)
    target = body.kept(node)
    body.line(f"elementary_eigh({n}, {left}, {target});")
    body.spend(_SWEEPS * n * (n - 1) // 2 * (12 * n + 20))


WRITERS = {
    "cholesky": _cholesky,
    "triangular_solve": _triangular_solve,
    "lu": _lu,
    "permutation": _permutation,
    "geqrf": _geqrf,
    "householder_product": _householder_product,
    "eigh": _eigh,
}
"""Functions that write a node, by its operation."""
