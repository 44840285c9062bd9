"""Measure models of the two-link arm: beside published results, by the published protocol, and while it learns.

`table` trains all models on the letters (train 17, test e, q, v) and on random states (test three free swings), several
seeds in one program, and on further splits of the letters. `published` trains the structured DeLaN as its authors do.
`letters`, `speeds` and `online` are the experiments of the first DeLaN paper (Lutter, Ritter and Peters 2019).
`derivatives` compares two ways to the derivatives of a structured network's inverse dynamics.
"""

from functools import partial

from scripts.reports.arm.experiments import measure_letters, measure_online
from scripts.reports.arm.models import (
    TRIGONOMETRIC,
    WIDTHS,
    measure_network,
    measure_one_by_one,
    measure_plant,
    measure_published_protocol,
    measure_splits,
    measure_trigonometric,
)
from scripts.reports.run import AtLeast, Case
from scripts.reports.speed.networks import derivatives

PARTS = ("torque_mse", "inertial_mse", "coriolis_mse", "gravity_mse", "vpt_seconds")
MOMENTA = ("torque_from_momenta_mse", *PARTS[1:])
LETTERS = {
    "structured-delan": dict(zip(PARTS, (2.2e-5, 3.2e-5, 1.4e-5, 2.0e-5, 2.3), strict=True)),
    "black-box-delan": dict(zip(PARTS, (2.8e-5, 1.8e-5, 2.0e-5, 1.2e-5, 2.8), strict=True)),
    "feed-forward": dict(zip(PARTS, (6.2e-4, 7.8e-4, 6.4e-4, 1.1e-4, 1.8), strict=True)),
    "structured-hnn": dict(zip(MOMENTA, (5.4e-6, 2.8e-6, 6.2e-6, 2.8e-6, 2.9), strict=True)),
    "black-box-hnn": dict(zip(MOMENTA, (1.6e-5, 8.6e-3, 8.5e-3, 1.0e-5, 2.2), strict=True)),
}
STATES = {
    "structured-delan": {"torque_mse": 2.6e-4, "vpt_seconds": 5.99},
    "black-box-delan": {"torque_mse": 2.5e-1, "vpt_seconds": 4.76},
    "feed-forward": {"torque_mse": 7.0e-2, "vpt_seconds": 3.77},
    "structured-hnn": {"torque_from_momenta_mse": 5.5e-4, "vpt_seconds": 5.82},
    "black-box-hnn": {"torque_from_momenta_mse": 4.0e-2, "vpt_seconds": 4.84},
}
"""Lutter et al. (2019) and Lutter and Peters (2021), means of ten seeds; squared errors are sums over joints.
Prediction times of swings are means over all three motions, from the stored results; the printed ones are of two."""
PUBLISHED = {"characters": LETTERS, "uniform": STATES}
PLANT_VPT = {"characters": 3.31, "uniform": 6.47}
"""Valid prediction times of the true plant, s."""
TIMES = {"seconds_to_1.35e-05": 7.0, "seconds_to_1e-08": 20.0, "seconds_to_1e-09": 40.0, "seconds_to_1e-10": 110.0}
PROTOCOL = {"torque_mse": 3e-6, "inertial_mse": 1e-5, "coriolis_mse": 1e-5, "gravity_mse": 1e-5}
CODE = {"train_seconds": 108.0, "one_step_p50_us": 111.0}
"""The published implementation of the structured Lagrangian, measured on two cores."""


def to_reach(kind: str, name: str) -> dict[str, float | AtLeast]:
    """Published errors, a hundredth of them for structured models, which must also predict as long as the plant."""
    structured = kind.startswith("structured")
    factor = 100.0 if structured else 1.0
    bounds: dict[str, float | AtLeast] = {}
    for quantity, value in PUBLISHED[name][kind].items():
        if quantity == "torque_from_momenta_mse":
            # Published torques from recorded momenta are limited by the record; their error bounds ours instead.
            bounds |= {quantity: value, "torque_mse": value / factor}
        elif quantity != "vpt_seconds":
            bounds[quantity] = value / factor
    return bounds | ({"vpt_seconds": AtLeast(0.98 * PLANT_VPT[name])} if structured else {})


QUICK = {"seeds": 1, "steps": 5}
CASES = (
    *(Case(f"table/plant/{name}", partial(measure_plant, name)) for name in PUBLISHED),
    *(
        Case(
            f"table/{TRIGONOMETRIC}/{name}",
            partial(measure_trigonometric, name),
            bound={"torque_mse": 1e-20, "train_seconds": 1.0, "noisy_torque_mse": 5e-5} if name == "characters" else {},
        )
        for name in PUBLISHED
    ),
    *(
        Case(
            f"table/{kind}/{name}",
            partial(measure_network, kind, name),
            quick=QUICK,
            published=PUBLISHED[name][kind],
            bound=to_reach(kind, name),
        )
        for name in PUBLISHED
        for kind in WIDTHS
    ),
    *(
        Case(f"table/{kind}/splits", partial(measure_splits, kind), quick={"splits": 2, "split_seeds": 1, "steps": 5})
        for kind in (*WIDTHS, TRIGONOMETRIC)
    ),
    Case(
        "table/structured-delan/gauss-newton",
        measure_one_by_one,
        quick={"timed_seeds": 1, "steps": 5},
        bound={**TIMES, "torque_mse_largest": 1e-8, "cost_of_ten_seeds": 8.0},
    ),
    Case(
        "published/structured-delan",
        measure_published_protocol,
        quick={"steps": 500},
        published={**CODE, **LETTERS["structured-delan"]},
        bound={**PROTOCOL, "train_seconds": 45.0, "one_step_p50_us": 37.0},
    ),
    *(
        Case(f"{by}/embedded", partial(measure_letters, by), quick={"splits": 1, "seeds": 1, "rounds": 2})
        for by in ("letters", "speeds")
    ),
    *(
        Case(f"online/{name}", partial(measure_online, name, **under), quick={"letters": 2, "seeds": 1, "rounds": 1})
        for name, under in {
            "online-nominal": {},
            "online-low-gains": {"gains": 0.1},
            "online-double-speed": {"speed": 2.0},
            "online-noisy-encoders": {"encoder_noise": 3e-4},
        }.items()
    ),
    Case("derivatives/structured-delan", derivatives, quick={"repetitions": 2, "width": 8}),
)
