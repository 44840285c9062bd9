# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""Newton's `SolverSemiImplicit`: symplectic Euler steps in single precision, with derivatives by Warp's tape.

Its material is Smith's law with the logarithm. The tape keeps the states of all steps.
"""

import itertools
from typing import Any

import numpy as np
import warp as wp

wp.config.quiet = True

import newton  # noqa: E402

from scripts.reports.soft_bodies.rivals.body import GRAVITY, Body, Run, measured, smith  # noqa: E402
from scripts.reports.soft_bodies.rivals.newton_vbd import add_body  # noqa: E402


@wp.kernel
def _same_material(parameters: wp.array[float], materials: wp.array2d[float]):
    place = wp.tid()
    materials[place, 0] = parameters[0]
    materials[place, 1] = parameters[1]


@wp.kernel
def _mean_height(q: wp.array[wp.vec3], mean: wp.array[float]):
    place = wp.tid()
    wp.atomic_add(mean, 0, q[place][2] / float(q.shape[0]))


def motion(body: Body, dt: float) -> Run:
    """A motion with steps of dt in s."""
    model = _model(body, requires_grad=False)
    solver, control = newton.solvers.SolverSemiImplicit(model), model.control()
    ends = np.round(body.times / dt).astype(int)

    def run() -> np.ndarray:
        now, after, out = model.state(), model.state(), []
        for count in np.diff(ends, prepend=0):
            for _ in range(count):
                now.clear_forces()
                solver.step(now, after, control, None, dt)
                now, after = after, now
            out.append(now.particle_q.numpy().astype(float))
        return np.array(out)

    return measured(body, run)


def motion_gradient(body: Body, dt: float, change: float = 1e-2) -> tuple[Run, float, float]:
    """Derivative of the mean height at the end by Young's modulus, in m/Pa, by reverse mode.

    Returns its time and value, and central differences of motions for a relative change that suits single precision.
    """
    model = _model(body, requires_grad=True)
    solver, control = newton.solvers.SolverSemiImplicit(model), model.control()
    states = [model.state(requires_grad=True) for _ in range(round(float(body.times[-1]) / dt) + 1)]
    both = np.array(smith(*body.lame))
    parameters = wp.array(both, dtype=float, requires_grad=True)
    mean = wp.zeros(1, dtype=float, requires_grad=True)

    def slope() -> Any:
        mean.zero_()
        with wp.Tape() as tape:
            wp.launch(_same_material, model.tet_count, [parameters], [model.tet_materials])
            for now, after in itertools.pairwise(states):
                now.clear_forces()
                solver.step(now, after, control, None, dt)
            wp.launch(_mean_height, model.particle_count, [states[-1].particle_q], [mean])
        tape.backward(mean)
        by_parameters = parameters.grad.numpy().astype(float)
        tape.zero()
        return by_parameters @ both / body.modulus  # both parameters are proportional to Young's modulus

    end = body._replace(times=body.times[-1:])
    up, down = (motion(end._replace(modulus=f * body.modulus), dt).x[-1, :, 2].mean() for f in (1 + change, 1 - change))
    run = measured(body, slope)
    return run, float(run.x), float(up - down) / (2 * change * body.modulus)


def _model(body: Body, *, requires_grad: bool) -> Any:
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
    add_body(builder, body, smith(*body.lame))
    return builder.finalize(device="cpu", requires_grad=requires_grad)
