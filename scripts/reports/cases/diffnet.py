"""Measure differential networks: errors beside the published table, and the cost of their derivatives.

`table` trains networks for sin and cos_sin with all activations, losses and optimisers of the published table; the ReLU
network's Hessian is zero almost everywhere, so that its error is that of predicting zero. `one-pass` times value,
gradient and Hessian against jax.hessian. All programs take turns; medians are compared.
"""

from functools import partial

from scripts.reports.networks import measure_function, measure_one_pass
from scripts.reports.run import AtLeast, Case

ERRORS = ("value_mse", "gradient_mse", "hessian_mse")
PUBLISHED = {
    ("sin", "type1", "relu"): (9.8e-6, 4.5e-4, 5.0e-1),
    ("sin", "type1", "softplus"): (6.9e-6, 1.8e-4, 5.9e-3),
    ("sin", "type1", "tanh"): (8.2e-7, 3.1e-5, 1.6e-3),
    ("sin", "type1", "cos"): (2.0e-7, 2.2e-6, 5.5e-5),
    ("sin", "type2", "relu"): (5.1e-7, 2.7e-3, 5.0e-1),
    ("sin", "type2", "softplus"): (8.7e-6, 1.5e-4, 4.5e-3),
    ("sin", "type2", "tanh"): (7.6e-6, 4.3e-4, 8.6e-3),
    ("sin", "type2", "cos"): (1.7e-8, 5.7e-7, 1.2e-5),
    ("cos_sin", "type1", "relu"): (4.2e-5, 2.0e-3, 1.0),
    ("cos_sin", "type1", "softplus"): (2.9e-6, 3.7e-5, 1.3e-3),
    ("cos_sin", "type1", "tanh"): (2.6e-6, 1.5e-5, 8.5e-4),
    ("cos_sin", "type1", "cos"): (2.9e-7, 4.3e-6, 1.7e-4),
    ("cos_sin", "type2", "relu"): (3.3e-5, 5.0e-3, 1.0),
    ("cos_sin", "type2", "softplus"): (4.3e-5, 8.1e-4, 1.5e-2),
    ("cos_sin", "type2", "tanh"): (8.4e-6, 4.3e-4, 1.2e-2),
    ("cos_sin", "type2", "cos"): (2.1e-6, 7.0e-5, 1.3e-3),
}
"""Mean squared errors of the published table: Adam, 128 units a layer."""
FACTORS = {"sin": 30.0, "cos_sin": 10.0}
"""Our error with cosines by Gauss-Newton must beat the best published one of the function by this factor."""
BEST = {name: [min(row[i] for key, row in PUBLISHED.items() if key[0] == name) for i in range(3)] for name in FACTORS}


def to_reach(function: str, loss: str, activation: str, optimizer: str) -> dict[str, float]:
    """Bounds of the best row of a function."""
    if (loss, activation, optimizer) != ("type1", "cos", "gauss-newton"):
        return {}
    return {name: best / FACTORS[function] for name, best in zip(ERRORS, BEST[function], strict=True)}


CASES = (
    *(
        Case(
            f"table/{'-'.join(key)}/{optimizer}",
            partial(measure_function, *key, optimizer),
            quick={"samples": 512, "steps": 2, "coarse_steps": 2, "epochs": 1},
            published=dict(zip(ERRORS, row, strict=True)),
            bound=to_reach(*key, optimizer),
        )
        for optimizer in ("gauss-newton", "adam")
        for key, row in PUBLISHED.items()
        if (optimizer, key[2]) != ("gauss-newton", "relu")
    ),
    Case(
        "one-pass/beside-jax-hessian",
        measure_one_pass,
        quick={"inputs": 2, "width": 8, "repetitions": 2},
        bound={f"diffnet-pass/n-{n} speedup_over_jax_hessian": AtLeast(4.0) for n in (2, 7)},
    ),
)
