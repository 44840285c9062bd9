"""Factorisations of small dense matrices in C, and triangular solves."""

from collections.abc import Collection
from textwrap import dedent

from dln_jax.deploy.c.body import Body
from dln_jax.deploy.c.nodes import Node

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
    static void permutation(int n, int exchanges, const int32_t *pivots, int32_t *order)
    {
        for (int i = 0; i < n; ++i) order[i] = i;
        for (int k = 0; k < exchanges; ++k) {
            const int32_t moved = order[k], pivot = pivots[k] < 0 ? 0 : pivots[k] < n ? pivots[k] : n - 1;
            order[k] = order[pivot];
            order[pivot] = moved;
        }
    }
    """,
}
"""C functions that are put into a source that needs them."""


def definitions(names: Collection[str], suffix: str) -> str:
    """C text of these functions."""
    text = "".join("\n" + dedent(FUNCTIONS[name]).strip() + "\n" for name in FUNCTIONS if name in names)
    return text.replace("SQRT(", f"sqrt{suffix}(").replace("FABS(", f"fabs{suffix}(")


def _cholesky(body: Body, node: Node) -> None:
    (a,) = node.args
    n = a.shape[0]
    body.source.kernels.add("cholesky")
    body.kept(node)
    body.line(f"cholesky({n}, {body.pointer(a)}, {body.pointer(node)});")
    body.spend(n * (n + 1) * (n + 2) // 3)


def _triangular_solve(body: Body, node: Node) -> None:
    a, b = node.args
    n, columns = b.shape
    lower, unit = map(int, node.attribute)
    body.source.kernels.add("triangular_solve")
    body.kept(node)
    sizes = f"{n}, {columns}, {lower}, {unit}"
    body.line(f"triangular_solve({sizes}, {body.pointer(a)}, {body.pointer(b)}, {body.pointer(node)});")
    body.spend(n * n * columns)


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
    (pivots,) = node.args
    body.source.kernels.add("permutation")
    target = body.kept(node)
    body.line(f"permutation({node.size}, {pivots.size}, {body.pointer(pivots)}, {target});")


WRITERS = {
    "cholesky": _cholesky,
    "triangular_solve": _triangular_solve,
    "lu": _lu,
    "permutation": _permutation,
}
"""By the name of the node."""
