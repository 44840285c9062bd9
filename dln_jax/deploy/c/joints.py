"""What a network sees of the coordinates, as C: `models.features.joint_features`, its rate and its pull-back."""

from collections.abc import Iterable
from typing import Any

from dln_jax.deploy.c.text import table
from dln_jax.models.black_box import per_coordinate
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


def scale_table(description: dict[str, Any], scale: str, needs: Needs, precision: str) -> str:
    """The sizes by which a model divides, one for each coordinate."""
    size = description[scale]
    return table(scale, per_coordinate(needs, scale, tuple(size) if isinstance(size, list) else size), precision)


def functions(needs: Needs, names: Iterable[str] = _HEADS) -> str:
    """Definitions of `features(q, x)`, `feature_rates(x, qd, x_rate)` and `pull_back_features(x, x_adjoint, force)`."""
    revolute, prismatic = (
        [joint for joint, kind in enumerate(needs.joints) if kind == wanted] for wanted in ("revolute", "prismatic")
    )
    n = len(revolute)
    # Lines of each function; without a revolute joint, two of them do not use x.
    values, rates, forces = [], [] if n else ["(void)x;"], [] if n else ["(void)x;"]
    for k, joint in enumerate(revolute):
        values += [f"x[{k}] = cos${{f}}(q[{joint}]);", f"x[{n + k}] = sin${{f}}(q[{joint}]);"]
        rates += [f"x_rate[{k}] = -x[{n + k}] * qd[{joint}];", f"x_rate[{n + k}] = x[{k}] * qd[{joint}];"]
        forces.append(f"force[{joint}] = x[{k}] * x_adjoint[{n + k}] - x[{n + k}] * x_adjoint[{k}];")
    for k, joint in enumerate(prismatic, start=2 * n):
        values.append(f"x[{k}] = q[{joint}];")
        rates.append(f"x_rate[{k}] = qd[{joint}];")
        forces.append(f"force[{joint}] = x_adjoint[{k}];")
    lines = dict(zip(_HEADS, (values, rates, forces), strict=True))
    return "".join(_HEADS[name] + "{\n" + "".join(f"    {line}\n" for line in lines[name]) + "}\n" for name in names)
