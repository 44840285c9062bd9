"""
C in a loop
===========

A model identified from data becomes C99 without dependencies. Computed torque control calls it once per millisecond and
moves the tip of the two-link arm along a circle.
"""

import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from dln_jax import dynamics, export_c, load_c
from dln_jax.figures import style
from dln_jax.learning.linear import fit_linear
from dln_jax.models.trigonometric import make_trigonometric
from dln_jax.scenes.datasets.generators import uniform
from dln_jax.scenes.pendulums import LINK_LENGTH, joint_angles, two_link_arm

jax.config.update("jax_enable_x64", True)

TICKS = 1_000  # of 1 ms

# %%
# The model
# ---------
# If all joints are revolute, the energy is linear in its parameters. One least-squares problem replaces a network.

scene = two_link_arm()
model = make_trigonometric(scene.needs)
fitted = fit_linear(model, uniform(scene, samples=500))
print(f"{fitted.parameter_count} parameters, rank {fitted.rank}, torque MSE {fitted.torque_mse:.1e} (N m)²")

# %%
# The C
# -----
# Here we export the inverse model and its derivative with respect to the angles, as a header and a source with a demo
# and a CMake file. `load_c` compiles them with your C compiler and calls them from Python. For a robot, compile them
# into your controller.

state = np.array([0.3, 1.2]), np.array([0.5, -1.0]), np.array([2.0, 0.1])
inverse = dynamics(model.energies(fitted.parameters)).inverse_dynamics
folder = Path(tempfile.mkdtemp()) / "c"
files = export_c({"inverse_dynamics": (inverse, state), "stiffness": (jax.jacfwd(inverse), state)}, folder)
print("files:", ", ".join(path.name for path in files))
arm = load_c(folder)

assert np.abs(arm.stiffness(*state) - jax.jacfwd(inverse)(*state)).max() < 1e-12
exact = dynamics(scene.energies).inverse_dynamics(*state)
assert np.abs(arm.inverse_dynamics(*state) - exact).max() < 1e-9

# %%
# The loop
# --------
# The torque is the inverse model of the reference acceleration, which is corrected by the errors of position and rate.
# The plant is the textbook arm in JAX; the controller is the C.

plant = jax.jit(dynamics(scene.energies).forward_dynamics)
STEP = 1e-3  # s


def reference(t):
    """Joint angles while the tip goes round a circle of 0.3 m once a second."""
    angle = 2 * jnp.pi * t
    return joint_angles(jnp.array([1.1 + 0.3 * jnp.cos(angle), 0.4 + 0.3 * jnp.sin(angle)]))


times = STEP * np.arange(TICKS)
rate = jax.jacfwd(reference)
path = [np.asarray(jax.jit(jax.vmap(function))(times)) for function in (reference, rate, jax.jacfwd(rate))]
q, qd = path[0][0] + np.array([0.2, -0.2]), path[1][0]  # the arm starts beside the path
angles, errors, spent = [], [], []
for q_wanted, qd_wanted, qdd_wanted in zip(*path, strict=True):
    began = time.perf_counter()
    tau = arm.inverse_dynamics(q, qd, qdd_wanted + 20 * (qd_wanted - qd) + 100 * (q_wanted - q))
    spent.append(1e6 * (time.perf_counter() - began))
    qd = qd + STEP * np.asarray(plant(jnp.asarray(q), jnp.asarray(qd), tau))
    q = q + STEP * qd
    angles.append(q)
    errors.append(np.abs(q - q_wanted).max())
print(f"error {errors[0]:.3f} rad at first, {errors[-1]:.1e} rad at last; {np.median(spent):.1f} µs a call from Python")
assert errors[-1] < 0.02 and errors[-1] < errors[0]

# %%
# The figure shows the arm on its circle, and the times of calls from Python: of the C, and of the compiled JAX
# function.

compiled, in_jax = jax.jit(inverse), []
for q, qd, qdd in zip(*path, strict=True):
    began = time.perf_counter()
    compiled(q, qd, qdd).block_until_ready()
    in_jax.append(1e6 * (time.perf_counter() - began))
figure, (left, right) = plt.subplots(1, 2, figsize=(8, 4), layout="constrained")
style.prepare(right)
q = np.array(angles)
elbow = LINK_LENGTH * np.stack([np.cos(q[:, 0]), np.sin(q[:, 0])], axis=1)
tip = elbow + LINK_LENGTH * np.stack([np.cos(q.sum(axis=1)), np.sin(q.sum(axis=1))], axis=1)
turn = np.linspace(0, 2 * np.pi, 100)
left.plot(1.1 + 0.3 * np.cos(turn), 0.4 + 0.3 * np.sin(turn), color="0.85", linewidth=8)
left.plot(*tip.T, color=style.BLUE, linewidth=2)
for index, alpha in zip((0, 400, TICKS - 1), (0.15, 0.4, 1.0), strict=True):
    links = np.stack([np.zeros(2), elbow[index], tip[index]])
    left.plot(*links.T, "o-", color="#3b4252", linewidth=6, markersize=9, alpha=alpha, solid_capstyle="round")
left.set(aspect="equal")
left.set_axis_off()
bins = np.geomspace(min(spent), np.quantile(in_jax, 0.99), 60)
for name, sample, colour in (("C", spent, style.BLUE), ("JAX", in_jax[1:], style.ORANGE)):
    right.hist(sample, bins, color=colour, alpha=0.8, label=f"{name}: median {np.median(sample):.0f} µs")
right.set(xscale="log", xlabel="one call from Python, µs", ylabel="calls")
style.legend(right, loc="upper center")
