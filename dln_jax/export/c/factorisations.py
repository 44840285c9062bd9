"""C text of factorisations of small dense matrices, and of triangular solves."""

from collections.abc import Collection
from string import Template
from textwrap import dedent

from dln_jax.export.c.body import Body
from dln_jax.export.c.nodes import Node

_SWEEPS = 16
"""Maximum number of Jacobi sweeps; random matrices of 6 rows need 5 to 7, of 40 rows 8 to 10."""

FUNCTIONS = {
    "cholesky": """
    /* Lower triangular l with l l^T = a [n, n]; all NaN where a is not positive definite */
    static void elementary_cholesky(int n, const real *a, real *l)
    {
        int definite = 1; /* a NaN reaches all elements that depend on it */
        for (int i = 0; i < n; ++i)
            for (int j = 0; j < n; ++j) {
                real rest = a[i * n + j];
                if (j > i) {
                    l[i * n + j] = 0;
                    continue;
                }
                for (int k = 0; k < j; ++k) rest -= l[i * n + k] * l[j * n + k];
                l[i * n + j] = i == j ? sqrt${f}(rest) : rest / l[j * n + j];
                definite &= i != j || !(rest <= 0);
            }
        for (int i = 0; !definite && i < n * n; ++i) l[i] = (real)NAN;
    }
    """,
    "triangular_solve": """
    /* x [n, columns] with a x = b, a lower or upper triangular */
    static void elementary_triangular_solve(
        int n, int columns, int lower, int unit, const real *a, const real *b, real *x)
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
    static void elementary_lu(int n, int m, const real *a, real *packed, int *pivots, int *order)
    {
        for (int i = 0; i < n * m; ++i) packed[i] = a[i];
        for (int i = 0; i < n; ++i) order[i] = i;
        for (int k = 0; k < n && k < m; ++k) {
            int pivot = k;
            for (int i = k + 1; i < n; ++i)
                if (fabs${f}(packed[i * m + k]) > fabs${f}(packed[pivot * m + k])) pivot = i;
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
                const real size = fabs${f}(packed[i * n + k]);
                largest = size > largest ? size : largest;
            }
            for (int i = k + 1; i < m; ++i) { /* scaled, so that no square overflows; a NaN stays one */
                const real scaled = packed[i * n + k] / (largest > 0 ? largest : 1);
                below += scaled * scaled;
            }
            *tau = 0;
            if (below == 0) continue;
            const real rest = largest * sqrt${f}(below), scale = fabs${f}(*corner) > rest ? fabs${f}(*corner) : rest;
            const real u = *corner / scale, v = rest / scale, length = scale * sqrt${f}(u * u + v * v);
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
       all NaN where an element is not finite, or after $sweeps sweeps. `left` is a workspace of n n numbers */
    static void elementary_eigh(int n, const real *a, real *left, real *vectors)
    {
        real *values = vectors + n * n;
        int rotated = 1, finite = 1;
        for (int i = 0; i < n * n; ++i) {
            left[i] = a[i];
            vectors[i] = i / n == i % n ? (real)1 : 0;
            finite &= a[i] - a[i] == 0;
        }
        for (int sweep = 0; finite && rotated && sweep < $sweeps; ++sweep) {
            rotated = 0;
            for (int p = 0; p < n; ++p)
                for (int q = p + 1; q < n; ++q) {
                    const real x = left[p * n + p], y = left[q * n + q], z = left[p * n + q];
                    if (fabs${f}(x) + fabs${f}(z) == fabs${f}(x) && fabs${f}(y) + fabs${f}(z) == fabs${f}(y)) continue;
                    const real theta = (y / 2 - x / 2) / z, size = fabs${f}(theta);
                    const real tangent = (theta < 0 ? -(real)1 : 1) / (size + sqrt${f}(1 + size * size));
                    const real c = 1 / sqrt${f}(1 + tangent * tangent), s = tangent * c;
                    rotated = 1;
                    for (int i = 0; i < n; ++i) {
                        const real u = vectors[i * n + p], v = vectors[i * n + q];
                        vectors[i * n + p] = c * u - s * v;
                        vectors[i * n + q] = s * u + c * v;
                        if (i == p || i == q) continue;
                        const real e = left[i * n + p], f = left[i * n + q];
                        left[i * n + p] = left[p * n + i] = c * e - s * f;
                        left[i * n + q] = left[q * n + i] = s * e + c * f;
                    }
                    left[p * n + p] = x - tangent * z;
                    left[q * n + q] = y + tangent * z;
                    left[p * n + q] = left[q * n + p] = 0;
                }
        }
        for (int i = 0; i < n; ++i) values[i] = left[i * n + i];
        for (int k = 0; k < n; ++k) {
            int lowest = k;
            for (int i = k + 1; i < n; ++i) lowest = values[i] < values[lowest] ? i : lowest;
            const real moved = values[k];
            values[k] = values[lowest];
            values[lowest] = moved;
            for (int i = 0; i < n && lowest != k; ++i) {
                const real swapped = vectors[i * n + k];
                vectors[i * n + k] = vectors[i * n + lowest];
                vectors[i * n + lowest] = swapped;
            }
        }
        for (int i = 0; (rotated || !finite) && i < n * n + n; ++i) vectors[i] = (real)NAN;
    }
    """,
}
"""C functions by the name of their node; a source contains only the called functions."""


def definitions(names: Collection[str], suffix: str) -> str:
    """Returns the C text of the named functions."""
    text = "".join("\n" + dedent(FUNCTIONS[name]).strip() + "\n" for name in FUNCTIONS if name in names)
    return Template(text).substitute(f=suffix, sweeps=_SWEEPS)


_COSTS = {
    "cholesky": lambda n: {"multiply_add": (n**3 - n) // 6, "div": n * (n - 1) // 2, "sqrt": n},
    "triangular_solve": lambda n, columns: {"multiply_add": n * (n - 1) // 2 * columns, "div": n * columns},
    "lu": lambda n, m: {
        "multiply_add": sum((n - k) * (m - k) for k in range(1, min(n, m) + 1)),
        "div": sum(n - k for k in range(1, min(n, m) + 1)),
    },
    "permutation": lambda n, exchanges: {},
    "geqrf": lambda m, n: {
        "multiply_add": 2 * m * n * min(m, n), "mul": 2 * m * n * min(m, n), "div": min(m, n) * (2 * m + 5),
        "sqrt": 2 * min(m, n),
    },
    "householder_product": lambda m, n, k: {"multiply_add": 2 * m * n * k, "mul": m * n * k},
    "eigh": lambda n: {
        name: _SWEEPS * n * (n - 1) // 2 * count
        for name, count in {"mul": 8 * n + 4, "add": 4 * n + 9, "div": 5, "sqrt": 2}.items()
    },
}  # fmt: skip
"""Upper bound on the operations of a C function, from its sizes."""


def _call(body: Body, node: Node) -> None:
    """Calls a node's C function with sizes, pointers to the arguments, and arrays for the results."""
    a = node.args[0]
    sizes, arrays = a.shape, []
    match node.op:
        case "triangular_solve":
            sizes = node.args[1].shape
        case "permutation":
            sizes = *node.shape, *a.shape
        case "householder_product":
            sizes = *a.shape, *node.args[1].shape
        case "lu":  # results of two types, which `project` nodes read
            arrays = [("real", a.size), ("int", min(a.shape)), ("int", a.shape[0])]
        case "cholesky":
            sizes = a.shape[:1]
        case "eigh":
            sizes, arrays = a.shape[:1], [("real", a.size)]  # a workspace
    targets = [f"v{node.number}_{place}" for place in range(len(arrays))]
    for target, (kind, size) in zip(targets, arrays, strict=True):
        body.declared(target, kind, size)
    if node.op != "lu":
        targets.append(body.kept(node))
    values = [*sizes, *map(int, node.attribute or ()), *map(body.pointer, node.args), *targets]
    body.line(f"elementary_{node.op}({', '.join(map(str, values))});")
    body.spend(**_COSTS[node.op](*sizes))


WRITERS = dict.fromkeys(FUNCTIONS, _call)
"""Functions that write a node, by its operation."""
