"""
A pendulum in space, from its energy
====================================

You write a Lagrangian as a function of one state, and get its equations of motion. Nothing is learned here. A mass
hangs on a rod and swings in all directions; q = (polar angle from the downward vertical, azimuth).
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from dln_jax import LagrangianSystem, dynamics
from dln_jax.figures import style
from dln_jax.mechanics.integrators import (
    explicit_euler,
    gauss_legendre4,
    implicit_midpoint,
    rk4,
    rollout,
)

jax.config.update("jax_enable_x64", True)

MASS, LENGTH, GRAVITY = 1.0, 0.8, 9.81  # kg, m, m/s²
SECONDS = 10

# %%
# The energy
# ----------
# The Lagrangian is kinetic minus potential energy, in J. Any differentiable function will do.


def lagrangian(q, qd):
    polar, _ = q
    kinetic = 0.5 * MASS * LENGTH**2 * (qd[0] ** 2 + (jnp.sin(polar) * qd[1]) ** 2)
    return kinetic + MASS * GRAVITY * LENGTH * jnp.cos(polar)


pendulum = dynamics(LagrangianSystem(lagrangian))

# %%
# A steady rotation
# -----------------
# On a cone of polar angle a, the pendulum turns steadily at sqrt(g / (l cos a)) without any torque.

cone = 0.7
turning = jnp.sqrt(GRAVITY / (LENGTH * jnp.cos(cone)))
q, qd = jnp.array([cone, 0.0]), jnp.array([0.0, turning])
tau = pendulum.inverse_dynamics(q, qd, jnp.zeros(2))
print(f"torque on the cone {tau} N m, mass matrix\n{pendulum.mass_matrix(q)}")
assert jnp.abs(tau).max() < 1e-12

# %%
# A free motion
# -------------
# `rollout` integrates any state; here its rate comes from the forward model. The whole motion is one compiled program.

start = jnp.array([1.2, 0.0]), jnp.array([0.0, 1.5])
times = jnp.linspace(0, SECONDS, 100 * SECONDS + 1)


def rate(t, state):
    q, qd = state
    return qd, pendulum.forward_dynamics(q, qd, jnp.zeros(2))


q, qd = jax.jit(lambda state: rollout(rk4(rate), state, times, substeps=4))(start)

# %%
# Energy and angular momentum about the vertical are conserved.

energy = jax.vmap(pendulum.energy)(q, qd)
momentum = MASS * (LENGTH * jnp.sin(q[:, 0])) ** 2 * qd[:, 1]
drift = [float(jnp.abs(kept - kept[0]).max() / jnp.abs(kept[0])) for kept in (energy, momentum)]
print(f"largest relative change: energy {drift[0]:.1e}, angular momentum {drift[1]:.1e}")
assert max(drift) < 1e-7

# %%
# The mass moves between two circles of latitude, and its shadow on the floor is a rosette.

x, y = LENGTH * jnp.sin(q[:, 0]) * jnp.stack([jnp.cos(q[:, 1]), jnp.sin(q[:, 1])])
path = np.stack([x, y, -LENGTH * jnp.cos(q[:, 0])])
figure, axes = plt.subplots(figsize=(6, 5), subplot_kw={"projection": "3d"}, layout="constrained")
axes.plot(*path[:2], -1.1 * LENGTH, color="0.8", linewidth=1.2)
axes.plot(*path, color=style.BLUE, linewidth=1.6)
axes.plot(*np.stack([np.zeros(3), path[:, -1]], axis=1), color="#3b4252", linewidth=4)
axes.plot(*path[:, -1:], "o", color=style.VERMILLION, markersize=16)
axes.set(xlabel="x, m", ylabel="y, m", zlabel="z, m", zlim=(-1.1 * LENGTH, 0))
axes.locator_params(nbins=4)
axes.view_init(elev=22)
axes.set_box_aspect((1, 1, 0.7))

# %%
# Which integrator?
# -----------------
# Halving the step divides the error by 2 for explicit Euler, by 4 for the implicit midpoint rule, and by 16 for RK4 and
# Gauss-Legendre. Gauss-Legendre solves equations in every step, but its energy does not drift.

METHODS = {
    "explicit Euler": (explicit_euler, 1, style.ORANGE, "o"),
    "implicit midpoint": (implicit_midpoint, 2, style.VERMILLION, "s"),
    "RK4": (rk4, 4, style.BLUE, "^"),
    "Gauss-Legendre": (gauss_legendre4, 4, style.GREEN, "D"),
}
second = jnp.array([0.0, 1.0])


def end(method, steps):
    q, qd = jax.jit(lambda state: rollout(method(rate), state, second, substeps=steps))(start)
    return np.concatenate([q[-1], qd[-1]])


exact, steps = end(gauss_legendre4, 2000), 40 * 2 ** np.arange(4)
figure, axis = plt.subplots(figsize=(7.2, 4), layout="constrained")
style.prepare(axis)
for name, (method, order, colour, marker) in METHODS.items():
    errors = [np.linalg.norm(end(method, int(count)) - exact) for count in steps]
    gain = np.log2(errors[-2] / errors[-1])
    print(f"{name}: error {errors[-1]:.1e} with {steps[-1]} steps, measured order {gain:.2f}")
    assert abs(gain - order) < 0.3
    axis.loglog(steps, errors, marker=marker, color=colour, markersize=5)
    axis.annotate(name, (steps[-1], errors[-1]), (8, 0), textcoords="offset points", va="center", color=colour)
axis.set(xlabel="steps per second", ylabel="error of the state after 1 s (rad and rad/s)")
axis.set_xticks(steps, [str(count) for count in steps])
axis.minorticks_off()
