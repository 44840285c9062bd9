"""Measure controllers: swing-ups, a board, learned models, foreign plants, value functions, tracking, plans, and C."""

from dln_jax.learning.kinematics.search import Search
from scripts.reports.control import closed_loops, plans, plants, published, swing_ups, values
from scripts.reports.run import AtLeast, Case

POLES = ("cart-pole", "furuta")
MOTORS = {"acrobot": "elbow", "pendubot": "shoulder"}
RETURNS = {"pendulum": -30.96, "cart-pole": -25.05}
"""Mean returns of published policies from downward starts, re-run; the draw of the starts hardly matters."""
UP = {"down_up_share": AtLeast(1.0), "uniform_up_share": AtLeast(1.0)}


def small(plant: str, **numbers):
    """Settings of a fit for a quick run."""
    return {"fit": published.FITS[plant]._replace(starts=128, **numbers), "widths": (24, 24), "seeds": 1}


CASES = (
    *(Case(f"starts/{plant}", swing_ups.anywhere, {"plant": plant}, {"starts": 50}) for plant in POLES),
    *(
        Case(
            f"board/{name}-planned",
            swing_ups.planned,
            {"motor": motor},
            {"horizons": (1.6,), "slope_weights": (1e-3,), "guesses": 1},
            published={"score": 0.655} if name == "acrobot" else {},
            bound={"score": AtLeast(0.66)} if name == "acrobot" else {},
        )
        for name, motor in MOTORS.items()
    ),
    *(
        Case(
            f"{'swing-up' if model == 'known' else 'learned'}/{plant}-{model}",
            swing_ups.by_model,
            {"plant": plant, "model": model},
            {"seeds": 1, "starts": 10},
            bound={"success_share": AtLeast(0.995)} if model in ("known", "delan") else {},
        )
        for plant in POLES
        for model in ("known", "delan", "identified", "analytic")
    ),
    *(
        Case(
            f"{plant}-{sizes}",
            plants.swing_up,
            {"plant": plant, "sizes": sizes},
            {"starts": 10},
            bound={"success_share": AtLeast(0.99)},
        )
        for plant in plants.PLANTS
        for sizes in (0, 1, 2)
    ),
    *(
        Case(
            f"rig/late-by-{mean}-ms",
            plants.late_samples,
            {"milliseconds": mean},
            {"starts": 3},
            bound={"success_share": AtLeast(0.99)},
        )
        for mean in (0, 1, 3)
    ),
    Case(
        "equation/pendulum",
        values.equation,
        {"robust": False},
        {"width": 8, "samples": 512, "iterations": 5, "seeds": 1},
        published={f"down_return_{which}": RETURNS["pendulum"] for which in ("median", "worst")},
    ),
    Case(
        "equation/robust",
        values.equation,
        {"robust": True, "width": 16, "samples": 2048},
        {"width": 8, "samples": 512, "iterations": 5, "seeds": 1, "starts_down": 20},
    ),
    Case(
        "value/pendulum",
        values.pendulum,
        {},
        {**small("pendulum", iterations=4, seconds=1.0), "points": (41, 81)},
        published={"down_return": RETURNS["pendulum"]},
        bound={"down_return": AtLeast(-30.9), "median_relative_error": 1e-2, "grid_converged": AtLeast(1.0), **UP},
    ),
    *(
        Case(
            f"value/{plant}",
            values.beside_shooting,
            {"plant": plant},
            {**small(plant, iterations=3, seconds=0.5, steps=50), "starts_around": 4, "iterations": 5},
            published={"down_return": RETURNS[plant]} if plant in RETURNS else {},
            bound={
                "median_relative_error": 1e-2,
                **UP,
                **({"down_return": AtLeast(-25.0)} if plant in RETURNS else {}),
            },
        )
        for plant in ("cart-pole", "rotary-pendulum")
    ),
    *(
        Case(
            f"estimates/{plant}-{model}",
            swing_ups.estimates,
            {"plant": plant, "model": model},
            {"starts": 30},
            bound={f"estimates/{plant}/{model}/{name} torque_rms_ratio": 0.2 for name in ("extended", "unscented")},
        )
        for plant in reversed(POLES)
        for model in ("known", "identified", "analytic")
    ),
    Case(
        "tracking/seven-axis",
        closed_loops.tracking,
        quick={
            "seeds": 1,
            "motions": 4,
            "unseen": 1,
            "samples": 400,
            "steps": 2,
            "search": Search(starts=2, iterations=5),
        },
    ),
    Case("laws/in-c", closed_loops.laws_in_c, quick={"repeats": 3, "calls": 100, "cold": 50}),
    Case(
        "plans/beside-ipopt",
        plans.beside_ipopt,
        quick={"count": 2, "names": ("cart-pole", "shortest-time")},
        bound={
            "plans/all as_low_share": AtLeast(90 / 96),
            "wrongly_converged": 0,
            "wrongly_infeasible": 0,
            "cpu_over_ipopt": 1.0,
        },
    ),
    Case(
        "realtime/cart-pole",
        plans.beside_rivals,
        quick={"loops": 1, "rival_loops": 1},
        bound={"realtime/cart-pole/c p99_ms": 0.3},
    ),
    Case(
        "realtime/seven-axis",
        closed_loops.beyond_limits,
        quick={"seconds": 1.0},
        bound={"p99_ms": 1.0, "largest_angle_rad": closed_loops.RANGE},
    ),
    Case(
        "rail/cart-pole",
        closed_loops.on_a_rail,
        quick={"runs": 5},
        bound={"success_share": AtLeast(1.0), "farthest_m": plans.RAIL},
    ),
)
