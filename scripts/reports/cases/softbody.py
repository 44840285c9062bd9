"""Measure soft bodies: elements, hard cases, gradients, contact and speed, each number beside what one may expect.

Only `speed`, `compilation` and `rivals` depend on the machine. `rivals` measures the other simulators that are
installed (extra `[rivals]`), in minutes.
"""

from typing import Any

from scripts.reports.run import AtLeast, Case
from scripts.reports.soft_bodies import beams, contact, elements, gradients, rivals

FEW_CELLS = {"cells": (16, 4)}
STEPS = {"steps_not_converged": 0.0}
TOUCHING: dict[str, Any] = {
    **STEPS,
    "crossings": 0.0,
    "least_distance_metres": AtLeast(0.0),
    "most_iterations": 100.0,
}
SHORT = {"moments": 2}
MATERIALS = {**STEPS, "most_iterations": 100.0, "most_iterations_at_first": 12.0}
LOCKING: dict[str, Any] = {"error": 0.02, "locking/linear/nu=0.4999 error": AtLeast(0.5)}
LOCKING |= {f"locking/linear/nu={nu} error": 0.2 for nu in (0.3, 0.49)}
SLENDER: dict[str, Any] = {"tip_error": 0.03}
# Linear elements lock, mixed ones are too soft: one is not enough.
SLENDER |= {f"slender/{body} tip_error": AtLeast(0.5) for body in ("linear/2-d/nu=0.3", "mixed/2-d/nu=0.4999")}
GRADIENTS = ("controls", "mu", "lambda", "muscle_stiffness", "ground_stiffness", "friction", "rest_shape", "masses")
SPEED: dict[str, Any] = {
    **STEPS,
    "steps_per_second": AtLeast(6000.0),
    "environment_steps_per_second": AtLeast(15_000.0),
}
BEAMS = {**STEPS, "speed/beam-902-unknowns seconds_per_step": 8e-3, "speed/beam-3402-unknowns seconds_per_step": 40e-3}
BOUNCE: dict[str, Any] = dict(STEPS)
BOUNCE |= {f"bounce/average-vector-field/{dt}-ms lost_energy": 1e-3 for dt in (10, 5, 1)}
COMPILED = {"box-on-ground": 6.0, "self-contact": 12.0, "crawler-gradient": 5.0}

CASES = (
    Case("references/locking", elements.locking, quick={"coarser": 2}, bound=LOCKING),
    Case("references/slender", elements.slender, quick={"bodies": 1}, bound=SLENDER),
    Case(
        "hard/time-steps",
        beams.time_steps,
        quick={**FEW_CELLS, "lengths": (10.0,)},
        bound={**STEPS, "most_iterations": 12.0},
    ),
    Case("hard/materials", beams.materials, quick=FEW_CELLS, bound=MATERIALS),
    Case(
        "gradients/crawler",
        gradients.crawler,
        quick={"contact_steps": 40},
        bound={f"{key}_relative_error": 1e-7 for key in (*GRADIENTS, "x0", "v0")},
    ),
    Case(
        "contact/stack",
        contact.stack,
        quick={"stack_steps": 150},
        bound={**TOUCHING, "relative_error_of_force": 1e-6},
    ),
    Case(
        "contact/sliding",
        contact.sliding,
        quick={"slide_steps": 100},
        bound={**TOUCHING, "relative_error_of_way": 0.05},
    ),
    Case("contact/twisted-bar", contact.twisted_bar, quick={"turns": 1.0}, bound=TOUCHING),
    Case("contact/bounce", contact.bounce, quick={"milliseconds": (10.0,)}, bound=BOUNCE),
    Case("speed/creature", gradients.creature, quick={"steps": 200}, bound=SPEED),
    Case("speed/beams", beams.beams, quick={"steps": 10}, bound=BEAMS),
    Case("speed/backward", gradients.backward, quick={"repetitions": 5}, bound={"backward_over_forward": 0.5}),
    Case(
        "speed/stiffness",
        beams.stiffness,
        quick={"bars": 1},
        bound={"slowest_over_fastest_step": 2.0, "converged": AtLeast(1.0)},
    ),
    Case("speed/factorisation", beams.factorisation, quick={"bars": 1}, bound={"factor_and_solve_over_scipy": 1.5}),
    Case(
        "compilation/programs",
        beams.compilation,
        quick={"programs": ("box-on-ground",)},
        bound={f"compile/{name} seconds": bound for name, bound in COMPILED.items()},
    ),
    Case("rivals/swing", rivals.swing, quick=SHORT, by_name_only=True),
    Case("rivals/drop", rivals.drop, quick=SHORT, by_name_only=True),
    Case(
        "rivals/hanging",
        rivals.hanging,
        bound={"difference": 1e-5, "gradient_difference": 1e-5},
        by_name_only=True,
    ),
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
