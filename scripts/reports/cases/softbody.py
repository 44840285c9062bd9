"""Measure the speed of soft bodies, and speed against error beside other simulators.

`rivals` measures the other simulators that are installed (extra `[rivals]`), in minutes.
"""

from scripts.reports.run import AtLeast, Case
from scripts.reports.soft_bodies import rivals, speed

ALL_STEPS = {"steps_not_converged": 0.0}
SHORT = {"moments": 2}
CRAWLERS = {"steps_per_second": AtLeast(6000.0), "environment_steps_per_second": AtLeast(15_000.0)}
BEAMS = {"speed/beam-902-unknowns seconds_per_step": 8e-3, "speed/beam-3402-unknowns seconds_per_step": 40e-3}
STIFFNESS = {"slowest_over_fastest_step": 2.0, "converged": AtLeast(1.0)}
COMPILED = {"box-on-ground": 6.0, "self-contact": 12.0, "crawler-gradient": 5.0}

CASES = (
    Case("speed/creature", speed.creature, quick={"steps": 200}, bound={**ALL_STEPS, **CRAWLERS}),
    Case("speed/beams", speed.beams, quick={"steps": 10}, bound={**ALL_STEPS, **BEAMS}),
    Case("speed/backward", speed.backward, quick={"repetitions": 5}, bound={"backward_over_forward": 0.5}),
    Case("speed/stiffness", speed.stiffness, quick={"bars": 1}, bound=STIFFNESS),
    Case("speed/factorisation", speed.factorisation, quick={"bars": 1}, bound={"factor_and_solve_over_scipy": 1.5}),
    Case(
        "compilation/programs",
        speed.compilation,
        quick={"programs": ("box-on-ground",)},
        bound={f"compile/{name} seconds": bound for name, bound in COMPILED.items()},
    ),
    Case("rivals/swing", rivals.swing, quick=SHORT, by_name_only=True),
    Case("rivals/drop", rivals.drop, quick=SHORT, by_name_only=True),
    Case("rivals/mesh", rivals.mesh_error, quick=SHORT, by_name_only=True),
    Case("rivals/gradient", rivals.motion_gradient, quick=SHORT, by_name_only=True),
    Case(
        "rivals/blocks",
        rivals.blocks,
        quick={"rest_seconds": 0.5},
        bound={"rivals/blocks-hit/dln_jax crossings": 0.0},
        by_name_only=True,
    ),
)
