"""
A function, its gradient and its Hessian
========================================

A differential network returns value, Jacobian and Hessian in one pass, by exact layer rules. Here it learns your own
function from values and gradients. Its Hessian is accurate as well, although the data contain none.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from dln_jax import GaussNewton
from dln_jax.data.functions import from_arrays, split
from dln_jax.figures import style
from dln_jax.learning.functions import Network, train
from dln_jax.nn.activations import activation
from dln_jax.nn.differential_mlp import value_jacobian_and_hessian

jax.config.update("jax_enable_x64", True)

SAMPLES, ITERATIONS = 2_000, 80

# %%
# Your own function
# -----------------
# Samples are rows: `x [N, n]`, `y [N, m]`, and the Jacobians `dy [N, m, n]` if you have them. The command
# `dln-jax train_diffnet --function mine.npz` reads the same arrays from an npz file.


def landscape(x):
    return jnp.sin(x[0]) * jnp.exp(-0.3 * x[1] ** 2) + 0.2 * x[0] * x[1]


x = np.random.default_rng(0).uniform(-2, 2, (SAMPLES, 2))
values, gradients = jax.vmap(jax.value_and_grad(landscape))(x)
data = from_arrays({"x": x, "y": np.asarray(values)[:, None], "dy": np.asarray(gradients)[:, None]})

# %%
# Training
# --------
# Gauss-Newton trains one hidden layer of 16 units on all samples at once. Loss "type1" uses values and gradients.

network = Network(loss="type1", width=16, activation="tanh", precision="f64")
training = train(split(data), network, GaussNewton(steps=ITERATIONS))
layers = jax.tree.map(lambda leaf: leaf[0], training.parameters)  # of the only member of the ensemble

# %%
# Three answers in one pass
# -------------------------

answers = jax.jit(jax.vmap(lambda x: value_jacobian_and_hessian(layers, x, activation=activation("tanh"))))
grid = np.random.default_rng(1).uniform(-2, 2, (1_000, 2))
y, dy, d2y = answers(grid)
errors = {
    "value": y[:, 0] - jax.vmap(landscape)(grid),
    "gradient": dy[:, 0] - jax.vmap(jax.grad(landscape))(grid),
    "Hessian": d2y[:, 0] - jax.vmap(jax.hessian(landscape))(grid),
}
for name, error in errors.items():
    print(f"{name}: root mean square error {float(jnp.sqrt(jnp.mean(error**2))):.1e}")
assert jnp.abs(errors["value"]).max() < 0.01 and jnp.abs(errors["Hessian"]).max() < 0.5

# %%
# The first figure shows the learned function as a landscape, with its gradients on the ground. The colour is the
# learned curvature (trace of the Hessian).

side = np.linspace(-2, 2, 60)
places = np.stack(np.meshgrid(side, side), axis=-1)
y, dy, d2y = answers(places.reshape(-1, 2))
curvature = np.trace(d2y[:, 0], axis1=1, axis2=2).reshape(60, 60)
colours = plt.get_cmap("RdBu_r")(0.5 + 0.5 * curvature / np.abs(curvature).max())
figure, axes = plt.subplots(figsize=(6.5, 5), subplot_kw={"projection": "3d"}, layout="constrained")
axes.plot_surface(
    *places.T, np.asarray(y).reshape(60, 60).T, facecolors=colours.transpose(1, 0, 2), rcount=60, ccount=60
)
few = places[3::6, 3::6].reshape(-1, 2)
slopes = np.asarray(dy).reshape(60, 60, 2)[3::6, 3::6].reshape(-1, 2)
ground = np.full(len(few), -1.8)
axes.quiver(*few.T, ground, *slopes.T, 0 * ground, length=0.25, color="0.4", linewidth=0.8)
axes.set(xlabel="$x_1$", ylabel="$x_2$", zlim=(-1.8, 1.2), zticks=[])
axes.view_init(elev=30, azim=-60)

# %%
# The second figure shows slope and curvature along a line.

line = np.stack([np.linspace(-2, 2, 200), np.zeros(200)], axis=1)
_, dy, d2y = answers(line)
figure, axes = plt.subplots(figsize=(6, 3.5), layout="constrained")
style.prepare(axes)
axes.plot(line[:, 0], jax.vmap(jax.grad(landscape))(line)[:, 0], "k", linewidth=3, label="slope")
axes.plot(line[:, 0], dy[:, 0, 0], "--", color=style.ORANGE, label="learned")
axes.plot(line[:, 0], jax.vmap(jax.hessian(landscape))(line)[:, 0, 0], color="0.6", linewidth=3, label="curvature")
axes.plot(line[:, 0], d2y[:, 0, 0, 0], "--", color=style.BLUE, label="learned, not in the data")
axes.set(xlabel="$x_1$ at $x_2$ = 0")
style.legend(axes)
