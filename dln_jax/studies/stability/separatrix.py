"""The pendulum let go just below upright, for 1e5 steps: it passes the saddle again and again.

A symplectic method follows a modified energy H + dt² f + ..., so that its energy error stays below dt^p times a number
that the backward error analysis gives, however long it runs. On the separatrix p² = 2 g (1 + c), c = cos q, of
H = p²/2 + g (1 - cos q), with f = 0 at the saddle c = -1:

    symplectic Euler    dt/2 |p V'| <= 0.770 g^1.5 dt
    Störmer-Verlet      dt²/24 (2 p² V'' - V'²) <= dt² g²/3
    implicit midpoint   dt²/24 (p² V'' + V'²) <= dt² g²/6
    Gauss-Legendre 4    of order dt⁴: (g dt²)² g

Source: Hairer, Lubich and Wanner, "Geometric Numerical Integration" (2006), sections IX.3 and IX.8.
"""

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.mechanics.integrators import (
    explicit_euler,
    gauss_legendre4,
    implicit_midpoint,
    rk4,
    rollout,
    stormer_verlet,
    symplectic_euler,
)
from dln_jax.scenes.pendulum import pendulum
from dln_jax.studies.case import Findings
from dln_jax.studies.report import expect, largest

GRAVITY = 9.81
DT = 0.01
"""s; 1e5 steps are 1000 s, some 130 swings."""
BELOW_UPRIGHT = 1e-3
"""rad from the saddle, where the swing starts from rest."""
HIGHER_ORDERS = 1.1
"""What the next orders of the expansion may add: g dt² and sqrt(g) dt are 0.001 and 0.03."""


def separatrix(steps: int) -> Findings:
    """Energy errors of all methods over `steps` steps, and whether the symplectic ones ever go over the top."""
    scene = pendulum(acceleration=GRAVITY)
    force = scene.gravity
    assert force is not None

    def field(t, state):
        q, p = state
        return p, -force(q)

    methods = {
        "explicit-euler": explicit_euler(field),
        "rk4": rk4(field),
        "symplectic-euler": symplectic_euler(lambda t, q, p: p, lambda t, q, p: -force(q)),
        "stormer-verlet": stormer_verlet(lambda t, p: p, lambda t, q: -force(q)),
        "implicit-midpoint": implicit_midpoint(field),
        "gauss-legendre-4": gauss_legendre4(field),
    }
    references = {
        "symplectic-euler": 4 / 2 / np.sqrt(3) * (2 / 3) * GRAVITY**1.5 * DT,
        "stormer-verlet": GRAVITY**2 * DT**2 / 3,
        "implicit-midpoint": GRAVITY**2 * DT**2 / 6,
        "gauss-legendre-4": GRAVITY * (GRAVITY * DT**2) ** 2,
    }
    # Of the motion only the angle of the end of each swing matters, and the largest error so far.
    kept = np.unique(np.geomspace(1, steps, 200).astype(int))
    start = (jnp.array([np.pi - BELOW_UPRIGHT]), jnp.zeros(1))
    t = DT * jnp.arange(steps + 1)
    cases, curves = [], {}
    for name, step in methods.items():
        q, p = jax.jit(lambda t, step=step: rollout(step, start, t))(t)
        q, p = np.asarray(q)[:, 0], np.asarray(p)[:, 0]
        with np.errstate(over="ignore", invalid="ignore"):
            energy = p**2 / 2 + GRAVITY * (1 - np.cos(q))
        # A motion that is lost has no error that grows back.
        error = np.maximum.accumulate(abs(energy - energy[0]))
        curves[name] = error[kept]
        if name not in references:
            continue
        reference = float(references[name])
        text = f"energy error over {steps:,} steps of {DT} s below the amplitude of the modified energy, no drift"
        got, bound = largest(error), HIGHER_ORDERS * reference
        cases.append(expect(f"separatrix/{name}", "largest_energy_error", text, got, bound, "J", reference=reference))
        text = f"released {BELOW_UPRIGHT:g} rad below upright, it never goes over the top: |q| < pi"
        below = float(np.pi) - largest(abs(q))
        cases.append(expect(f"separatrix/{name}", "least_angle_from_upright", text, below, 0.0, "rad", at_least=True))
    return Findings(cases, {"steps": kept, "errors": curves, "references": references})
