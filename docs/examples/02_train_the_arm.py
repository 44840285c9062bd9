"""
Train the arm, and look inside
==============================

A two-link arm writes letters. A structured Lagrangian network sees angles, rates, accelerations and torques, but not
the arm's masses, lengths or equations. It separates inertial, Coriolis and gravity forces, although it never sees them.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from dln_jax import GaussNewton, dynamics, fit, make, make_delan
from dln_jax.data.splits import split
from dln_jax.figures import style
from dln_jax.figures.torques import force_decomposition
from dln_jax.learning.dynamics import problem
from dln_jax.mechanics.integrators import rk4, rollout, second_order
from dln_jax.nn.activations import tanh
from dln_jax.scenes.datasets.generators import default_data
from dln_jax.scenes.pendulums import LINK_LENGTH, two_link_arm

jax.config.update("jax_enable_x64", True)

ITERATIONS = 60

# %%
# The data
# --------
# The arm writes twenty letters, which are outlines of a font and not the published recordings. Training never sees the
# three test letters. The best parameters are chosen on validation letters, which are drawn from the other seventeen.

scene = two_link_arm()
data = default_data(scene)._replace(needs=scene.needs)
sets = split(data, test=("e", "q", "v"))
print({name: len(part.t) for name, part in sets._asdict().items()}, scene.needs)

# %%
# The model
# ---------
# `Needs` states two revolute joints and gravity, but no friction. The network therefore gets cosines and sines of the
# angles and a potential, but no dissipation. Gauss-Newton trains two layers of 8 units (260 parameters).

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
# Writing with learned torques
# ----------------------------
# The true arm writes a test letter. The model gives the feedforward torques, and weak feedback corrects the rest.

letter = test.trajectory == test.trajectory[0]
t, *reference = (np.asarray(array[letter]) for array in (test.t, test.q, test.qd, test.qdd))
plant = dynamics(scene.closed_form)


def accelerate(time, q, qd):
    wanted = [jnp.stack([jnp.interp(time, t, column) for column in array.T]) for array in reference]
    feedback = 5.0 * (wanted[0] - q) + 1.0 * (wanted[1] - qd)
    return plant.forward_dynamics(q, qd, arm.inverse_dynamics(*wanted) + feedback)


start = jnp.asarray(reference[0][0]), jnp.asarray(reference[1][0])
q, _ = jax.jit(lambda start: rollout(rk4(second_order(accelerate)), start, t))(start)
wanted, tip = (np.asarray(jax.vmap(scene.tip)(jnp.asarray(angles))) for angles in (reference[0], q))
print(f"the tip stays within {1e3 * np.abs(tip - wanted).max():.2f} mm of the letter")
assert np.abs(tip - wanted).max() < 5e-3

elbow = LINK_LENGTH * np.stack([np.cos(q[:, 0]), np.sin(q[:, 0])], axis=1)
figure, axes = plt.subplots(figsize=(6, 4.5), layout="constrained")
axes.plot(*wanted.T, color="0.85", linewidth=8, solid_capstyle="round")
axes.plot(*tip.T, color=style.BLUE, linewidth=2)
for index, alpha in zip(np.linspace(0, len(t) - 1, 6).astype(int), np.linspace(0.12, 1, 6), strict=True):
    links = np.stack([np.zeros(2), elbow[index], tip[index]])
    axes.plot(*links.T, "o-", color="#3b4252", linewidth=6, markersize=9, alpha=alpha, solid_capstyle="round")
axes.set(aspect="equal")
axes.set_axis_off()

# %%
# Mass matrix and parts of the torque
# -----------------------------------
# Both follow from the learned energy. Torques alone determine M completely, because they are linear in the
# accelerations.

learned = jax.jit(jax.vmap(arm.mass_matrix))(test.q)
exact = jax.jit(jax.vmap(plant.mass_matrix))(test.q)
print(f"mass matrix: largest error {np.abs(learned - exact).max():.1e} of {np.abs(exact).max():.2f} kg m²")
assert np.abs(learned - exact).max() < 0.01

parts = jax.jit(jax.vmap(arm.decompose))(test.q, test.qd, test.qdd)
predicted = {"tau": tau, **{f"tau_{name}": getattr(parts, name) for name in parts._fields}}
decomposition = force_decomposition(test, jax.tree.map(np.asarray, predicted), model="structured-delan")

# %%
# Other models
# ------------
# A black-box network gives the Lagrangian as a whole, and a feed-forward network gives torques without an energy. With
# 401 and 900 parameters, they learn the same letters. The more structure a model has, the fewer steps it takes.

histories = {"structured-delan": training.history}
for name in ("black-box-delan", "feed-forward"):
    other = make(name, scene.needs, width=16, depth=2, activation="tanh")
    histories[name] = fit(problem(other, sets), GaussNewton(steps=ITERATIONS)).history

figure, axis = plt.subplots(figsize=(7.2, 4), layout="constrained")
style.prepare(axis)
for name, history in histories.items():
    steps, errors = np.array([(at.step, at.monitor) for at in history]).T
    axis.semilogy(steps, errors, color=style.colour(name), linewidth=1.6)
    look = {"color": style.colour(name), "fontsize": style.TEXT, "va": "center"}
    axis.annotate(name, (steps[-1], errors[-1]), (6, 0), textcoords="offset points", **look)
axis.set(xlabel="Gauss-Newton step", ylabel="torque MSE on the test letters, (N m)²")
assert histories["structured-delan"][-1].monitor < histories["feed-forward"][-1].monitor
