"""
Two bodies that attract each other
==================================

A Hamiltonian network learns gravity between two bodies from samples of a few motions. It is told that bodies interact
in pairs, by their distance alone. This helps more than any number of units: the network conserves the energy of an
orbit that it has not seen.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from dln_jax import GaussNewton, Needs, fit
from dln_jax.data.splits import hold_out
from dln_jax.figures import style
from dln_jax.learning.matching import rates_problem
from dln_jax.mechanics import equations
from dln_jax.mechanics.integrators import gauss_legendre4, rollout
from dln_jax.models.hamiltonian import make_pairwise_hamiltonian
from dln_jax.nn.activations import tanh
from dln_jax.scenes.datasets.hamiltonian_tasks import two_body

jax.config.update("jax_enable_x64", True)

TRAJECTORIES, ITERATIONS, SECONDS = 60, 60, 40

# %%
# The data
# --------
# The data are states (q, p) along orbits, and their rates. There are four coordinates, two for each body.

task = two_body(trajectories=TRAJECTORIES)
print(f"{len(task.train.data.t)} samples for training")

# %%
# The model
# ---------
# H = sum of p² / 2 m + sum over pairs of V(distance), where V is a network with one layer of 8 units. Gauss-Newton fits
# it to the rates.

model = make_pairwise_hamiltonian(Needs(("prismatic",) * 4), width=8, depth=1, activation=tanh, dtype=jnp.float64)
train, validation = hold_out(task.train.data, 0.1, seed=0)
training = fit(rates_problem(model, train, validation), GaussNewton(steps=ITERATIONS))
flow = equations.flow(model.energies(training.parameters))

# %%
# An unseen orbit
# ---------------
# A symplectic method conserves the learned energy. The change of the true energy therefore shows the model's error.

start = jnp.asarray(task.test.clean.q[0]), jnp.asarray(task.test.clean.p[0])
times = jnp.linspace(0, SECONDS, 20 * SECONDS + 1)
step = gauss_legendre4(lambda t, state: flow.rates(*state))
q, p = map(np.asarray, jax.jit(lambda start: rollout(step, start, times))(start))
energy = np.asarray(jax.vmap(task.hamiltonian)(q, p))
change = np.abs(energy - energy[0]).max() / abs(energy[0])
momentum = p.reshape(-1, 2, 2).sum(axis=1)
print(f"largest change of the true energy {change:.1e}, of the total momentum {np.ptp(momentum, axis=0).max():.1e}")
assert change < 1e-4 and np.ptp(momentum, axis=0).max() < 1e-10

figure, axes = plt.subplots(figsize=(6, 5), layout="constrained")
for body, colour in enumerate((style.BLUE, style.VERMILLION)):
    x, y = q[:, 2 * body], q[:, 2 * body + 1]
    axes.plot(x, y, color=colour, linewidth=0.6, alpha=0.35)
    for alpha, index in zip(np.linspace(0.1, 1, 60), range(-61, -1), strict=True):  # the last three seconds
        axes.plot(x[index:][:2], y[index:][:2], color=colour, linewidth=4, alpha=alpha)
    axes.plot(x[-1], y[-1], "o", color=colour, markersize=20)
axes.set(aspect="equal")
axes.set_axis_off()
