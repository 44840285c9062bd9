"""
C in a loop
===========

A model that was identified from data becomes C99 without dependencies, and is called once a millisecond: computed
torque control of the two-link arm along a circle of angles.
"""

import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from dln_jax import dynamics, export_c, load_c
from dln_jax.learning.linear import fit_linear
from dln_jax.models.trigonometric import make_trigonometric
from dln_jax.scenes import two_link_arm
from dln_jax.scenes.datasets.generators import uniform

jax.config.update("jax_enable_x64", True)

TICKS = 1_000  # of 1 ms

# %%
# The model
# ---------
# For revolute joints alone the energy is linear in its parameters: one least-squares problem, and no network.

scene = two_link_arm()
model = make_trigonometric(scene.needs)
fitted = fit_linear(model, uniform(scene, samples=500))
print(f"{fitted.parameter_count} parameters, rank {fitted.rank}, torque MSE {fitted.torque_mse:.1e} (N m)²")

# %%
# The C
# -----
# Any function of small arrays becomes a header and a source that need `<math.h>` alone, with a demo and a CMake file:
# here the inverse model, and its derivative by the angles. `load_c` compiles them with the compiler at hand and calls
# them from Python; on a robot you compile them into your controller.

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
# Computed torque: the inverse model of the wanted acceleration, corrected by what position and rate are off. The plant
# is the textbook arm, in one JAX function; the controller is the C.

plant = jax.jit(dynamics(scene.energies).forward_dynamics)
STEP = 1e-3  # s


def wanted(t):
    angle = 2 * np.pi * t
    q = np.array([0.5 * np.cos(angle), 1.0 + 0.5 * np.sin(angle)])
    qd = np.pi * np.array([-np.sin(angle), np.cos(angle)])
    return q, qd, 2 * np.pi**2 * np.array([-np.cos(angle), -np.sin(angle)])


q, qd, _ = wanted(0.0)
q = q + np.array([0.2, -0.2])  # the arm starts beside the path
errors, spent = [], 0.0
for tick in range(TICKS):
    q_wanted, qd_wanted, qdd_wanted = wanted(tick * STEP)
    began = time.perf_counter()
    tau = arm.inverse_dynamics(q, qd, qdd_wanted + 20 * (qd_wanted - qd) + 100 * (q_wanted - q))
    spent += time.perf_counter() - began
    qd = qd + STEP * np.asarray(plant(jnp.asarray(q), jnp.asarray(qd), tau))
    q = q + STEP * qd
    errors.append(np.abs(q - q_wanted).max())
print(f"error {errors[0]:.3f} rad at first, {errors[-1]:.1e} rad at last; {1e6 * spent / TICKS:.1f} µs a call of C")
assert errors[-1] < 0.02 and errors[-1] < errors[0]

figure, axes = plt.subplots(figsize=(6, 3))
axes.semilogy(STEP * np.arange(TICKS), errors)
axes.set(xlabel="time, s", ylabel="largest error, rad")
figure.tight_layout()
