"""C that sorts rows of numbers by one or several keys."""

from collections.abc import Collection, Sequence
from string import Template

from dln_jax.export.c.body import Body
from dln_jax.export.c.kinds import C_TYPES
from dln_jax.export.c.nodes import Node

_ORDER = """
/* Places of each row's elements [rows, n] in ascending order of their keys, by merging; NaN last */
static inline int $name_before(long long i, long long j$keys)
{
$comparisons    return 0;
}

static void $name(int rows, int n, long long *merged, long long *order$keys)
{
    for (int row = 0; row < rows; ++row, order += n) {
        for (int k = 0; k < n; ++k) order[k] = (long long)row * n + k;
        for (long long width = 1; width < n; width *= 2) {
            for (long long first = 0; first < n; first += 2 * width) {
                const long long middle = first + width < n ? first + width : n;
                const long long last = middle + width < n ? middle + width : n;
                long long i = first, j = middle;
                for (long long k = first; k < last; ++k) {
                    const int second = i == middle || (j < last && $name_before(order[j], order[i]$passed));
                    merged[k] = second ? order[j++] : order[i++];
                }
            }
            for (int k = 0; k < n; ++k) order[k] = merged[k];
        }
    }
}
"""
_COMPARISONS = """    if (KEY[i] < KEY[j]LAST_I) return 1;
    if (KEY[j] < KEY[i]LAST_J) return 0;
"""


def _name(kinds: Sequence[str]) -> str:
    return "_".join(("elementary_order", *kinds))


def _function(kinds: Sequence[str]) -> str:
    """Returns the C function that sorts by keys of these kinds, the first key first."""
    comparisons = ""
    for place, kind in enumerate(kinds):
        nan_last = " || (KEY[{0}] == KEY[{0}] && KEY[{1}] != KEY[{1}])" if kind == "real" else ""
        comparison = _COMPARISONS.replace("LAST_I", nan_last.format("i", "j")).replace(
            "LAST_J", nan_last.format("j", "i")
        )
        comparisons += comparison.replace("KEY", f"key{place}")
    keys = "".join(f", const {C_TYPES[kind]} *key{place}" for place, kind in enumerate(kinds))
    passed = "".join(f", key{place}" for place in range(len(kinds)))
    return Template(_ORDER.replace("$name", _name(kinds))).substitute(keys=keys, passed=passed, comparisons=comparisons)


def definitions(orders: Collection[tuple[str, ...]]) -> str:
    """Returns the C functions that sort by keys of these kinds."""
    return "".join(map(_function, sorted(orders)))


def order(body: Body, node: Node) -> None:
    """Writes a call of the function that sorts by the keys of a node."""
    rows, n = node.shape
    kinds, merged = tuple(key.dtype for key in node.args), f"v{node.number}_merged"
    body.source.orders.add(kinds)
    body.declared(merged, "index", n)
    target = body.kept(node)
    body.line(f"{_name(kinds)}({rows}, {n}, {merged}, {target}, {', '.join(map(body.pointer, node.args))});")
