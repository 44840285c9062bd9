"""
Train the arm, and look inside
==============================

A two-link arm writes letters. A structured Lagrangian network sees angles, rates, accelerations and torques, and
nothing of the arm's masses, lengths or equations. Inertial, Coriolis and gravity forces come out of it apart, unseen.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from dln_jax import GaussNewton, dynamics, fit, make_delan
from dln_jax.data.splits import split
from dln_jax.learning.dynamics import problem
from dln_jax.nn.activations import tanh
from dln_jax.scenes import two_link_arm
from dln_jax.scenes.datasets.generators import default_data

jax.config.update("jax_enable_x64", True)

ITERATIONS = 60

# %%
# The data
# --------
# Twenty letters, outlines of a font and not the published recordings. Three of them are the test, and are never looked
# at while training. The best parameters are chosen on validation letters, which are drawn from the other seventeen.

scene = two_link_arm()
data = default_data(scene)._replace(needs=scene.needs)
sets = split(data, test=("e", "q", "v"))
print({name: len(part.t) for name, part in sets._asdict().items()}, scene.needs)

# %%
# The model
# ---------
# `Needs` says that there are two revolute joints, gravity and no friction: the network gets cosines and sines of the
# angles and a potential, and no dissipation. Two layers of 8 units, 260 parameters, by Gauss-Newton.

model = make_delan(scene.needs, width=8, depth=2, activation=tanh, dtype=jnp.float64)
training = fit(problem(model, sets), GaussNewton(steps=ITERATIONS))
arm = dynamics(model.energies(training.parameters))

# %%
# The torques of the test letters
# -------------------------------

test = sets.test
tau = jax.jit(jax.vmap(arm.inverse_dynamics))(test.q, test.qd, test.qdd)
error = float(np.mean(np.sum((tau - test.tau) ** 2, axis=1)))
print(f"torque MSE {error:.1e} (N m)²; published, on recorded letters, 2.2e-5 (Lutter and Peters 2021)")
assert error < 1e-5

# %%
# What it was not shown
# ---------------------
# The mass matrix of the arm, and the parts of the torque. Both follow from the energy that was learned. (Torques alone
# fix M completely: they are linear in the accelerations.)

truth = dynamics(scene.energies)
learned = jax.jit(jax.vmap(arm.mass_matrix))(test.q)
exact = jax.jit(jax.vmap(truth.mass_matrix))(test.q)
print(f"mass matrix: largest error {np.abs(learned - exact).max():.1e} of {np.abs(exact).max():.2f} kg m²")
assert np.abs(learned - exact).max() < 0.01

parts = jax.jit(jax.vmap(arm.decompose))(test.q, test.qd, test.qdd)
names = ("inertial", "coriolis", "gravity")
figure, axes = plt.subplots(3, 1, figsize=(7, 6), sharex=True)
for axis, name in zip(axes, names, strict=True):
    axis.plot(getattr(test, f"tau_{name}")[:, 0], color="black", linewidth=2, label="truth")
    axis.plot(getattr(parts, name)[:, 0], "--", color="tab:red", label="learned")
    axis.set(ylabel=f"{name}, N m")
axes[0].legend(ncols=2, frameon=False)
axes[-1].set(xlabel="sample of the test letters e, q, v")
figure.tight_layout()
