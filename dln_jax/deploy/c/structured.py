"""Structured DeLaN and structured Hamiltonian as C: `mechanics.natural` and `mechanics.natural_hamiltonian`.

One derivative of the triangular factor along the motion and one pull-back, whose covector also takes in the gradient of
the potential, so that one pass back through the features serves both.
"""

from typing import Any

import numpy as np

from dln_jax.deploy.c import joints as c_joints
from dln_jax.deploy.c import networks as c_networks
from dln_jax.deploy.c.natural import DELAN, FACTOR, HAMILTONIAN
from dln_jax.deploy.c.networks import Network
from dln_jax.deploy.c.text import number, table
from dln_jax.types import Needs
from dln_jax.zoo.catalogue import CATALOGUE


def source(description: dict[str, Any], parameters: Any, needs: Needs, precision: str) -> str:
    """Body of the C source, with `$name` and `${f}` left to fill in."""
    delan = not CATALOGUE[description["name"]].properties.canonical
    shared = "energies/~/linear_0" in parameters
    factor = c_networks.from_haiku("factor", parameters, "energies" if shared else "cholesky")
    potential = None if shared or not needs.gravity else c_networks.from_haiku("potential", parameters, "potential")
    shift, floor = float(description["diagonal_shift"]), float(description["diagonal_floor"])
    friction = parameters.get("~", {}).get("viscous_friction")
    entries = needs.degrees_of_freedom * (needs.degrees_of_freedom + 1) // 2
    head = [
        f"enum {{ D = {needs.degrees_of_freedom}, FEATURES = {c_joints.count(needs)}, ENTRIES = {entries} }};\n",
        f"#define DIAGONAL_SHIFT {number(shift, precision)}\n#define DIAGONAL_FLOOR {number(floor, precision)}\n",
    ]
    if friction is not None:
        head.append("\n/* Viscous friction, N m s or N s/m */\n")
        head.append(table("friction", np.logaddexp(0, np.asarray(friction, np.float64)), precision))
    networks = c_networks.tables(factor, precision)
    functions = c_joints.functions(needs, ("features", "feature_rates", "pull_back_features"))
    functions += c_networks.trace(factor) + "".join(
        make(factor) for make in (c_networks.value, c_networks.rates, c_networks.pull_back)
    )
    if potential:
        networks += c_networks.tables(potential, precision)
        functions += c_networks.trace(potential) + c_networks.value(potential)
        functions += c_networks.slopes(potential, with_value=False) + c_networks.pull_back(potential)
    texts = _texts(factor, potential, shared=shared, friction=friction is not None)
    body = DELAN if delan else HAMILTONIAN
    for key, text in texts.items():
        body = body.replace(f"${{{key}}}", text)
    return "".join(head) + networks + functions + FACTOR + body


def _texts(factor: Network, potential: Network | None, *, shared: bool, friction: bool) -> dict[str, str]:
    outputs = "ENTRIES + 1" if shared else "ENTRIES"
    features = [
        f"real x[FEATURES], x_rate[FEATURES], x_adjoint[FEATURES], entries[{outputs}], rate[{outputs}],",
        f"    adjoint[{outputs}];",
        "factor_trace trace;",
        "features(q, x);",
        "feature_rates(x, qd, x_rate);",
        "factor_rates(x, x_rate, &trace, entries, rate);",
        "unpack_factor_rate(entries, rate, L, L_rate, diagonal_slope);",
    ]
    pull_back = ["adjoint[ENTRIES] = 1; /* the potential */"] * shared
    pull_back.append("factor_pull_back(&trace, adjoint, x_adjoint);")
    factor_values = [f"real x[FEATURES], entries[{outputs}];", "features(q, x);", "factor_value(x, entries);"]
    factor_values.append("unpack_factor(entries, L);")
    values, energy = list(factor_values), ""
    if potential:
        features[2:2] = ["const real one = 1;", "potential_trace potential;", "real potential_adjoint[FEATURES];"]
        pull_back += [
            "potential_slopes(x, &potential);",
            "potential_pull_back(&potential, &one, potential_adjoint);",
            "for (int k = 0; k < FEATURES; ++k) x_adjoint[k] += potential_adjoint[k];",
        ]
        values[1:1] = ["real potential;"]
        values.append("potential_value(x, &potential);")
        energy = " + potential"
    elif shared:
        energy = " + entries[ENTRIES]"
    pull_back.append("pull_back_features(x, x_adjoint, force);")
    return {
        "features": _lines(features),
        "pull_back": _lines(pull_back),
        "friction": " + friction[i] * qd[i]" if friction else "",
        "values": _lines(values),
        "factor_values": _lines(factor_values),
        "potential": energy,
    }


def _lines(lines: list[str]) -> str:
    return "\n".join(f"    {line}" for line in lines)
