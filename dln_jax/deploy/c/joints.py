"""What a network sees of the coordinates, as C: `models.features.joint_features`, its rate and its pull-back."""

from collections.abc import Iterable

from dln_jax.types import Needs

_HEADS = {
    "features": """
/* cos of the revolute joints, sin of them, then the prismatic ones */
static void features(const real *restrict q, real *restrict x)
""",
    "feature_rates": """
/* Rate of the features x where q changes at qd */
static void feature_rates(const real *restrict x, const real *restrict qd, real *restrict x_rate)
""",
    "pull_back_features": """
/* sum_k x_adjoint[k] dx_k/dq */
static void pull_back_features(const real *restrict x, const real *restrict x_adjoint, real *restrict force)
""",
}


def count(needs: Needs) -> int:
    """Number of features."""
    return sum(2 if joint == "revolute" else 1 for joint in needs.joints)


def functions(needs: Needs, names: Iterable[str] = _HEADS) -> str:
    """Definitions of `features(q, x)`, `feature_rates(x, qd, x_rate)` and `pull_back_features(x, x_adjoint, force)`."""
    revolute = [joint for joint, kind in enumerate(needs.joints) if kind == "revolute"]
    prismatic = [joint for joint, kind in enumerate(needs.joints) if kind == "prismatic"]
    n = len(revolute)
    lines: dict[str, list[str]] = {name: [] for name in _HEADS}
    for k, joint in enumerate(revolute):
        lines["features"] += [f"x[{k}] = cos${{f}}(q[{joint}]);", f"x[{n + k}] = sin${{f}}(q[{joint}]);"]
        lines["feature_rates"].append(f"x_rate[{k}] = -x[{n + k}] * qd[{joint}];")
        lines["feature_rates"].append(f"x_rate[{n + k}] = x[{k}] * qd[{joint}];")
        pulled = f"x[{k}] * x_adjoint[{n + k}] - x[{n + k}] * x_adjoint[{k}]"
        lines["pull_back_features"].append(f"force[{joint}] = {pulled};")
    if not revolute:
        lines["feature_rates"].append("(void)x;")
        lines["pull_back_features"].append("(void)x;")
    for k, joint in enumerate(prismatic, start=2 * n):
        lines["features"].append(f"x[{k}] = q[{joint}];")
        lines["feature_rates"].append(f"x_rate[{k}] = qd[{joint}];")
        lines["pull_back_features"].append(f"force[{joint}] = x_adjoint[{k}];")
    return "".join(_HEADS[name] + "{\n" + "".join(f"    {line}\n" for line in lines[name]) + "}\n" for name in names)
