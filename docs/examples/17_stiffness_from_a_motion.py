"""
Stiffness from a motion
=======================

A soft tail is clamped at one end and let go. Least squares through the time steps finds the stiffness of its two halves
from the observed motion. The result predicts a motion that was not fitted.
"""

from functools import partial

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import PolyCollection

from dln_jax.figures import style
from dln_jax.rollout import rollout
from dln_jax.softbody.identification import ObservedMotions, identify
from dln_jax.softbody.mesh.mesh import vertices_where
from dln_jax.softbody.mesh.shapes import beam
from dln_jax.softbody.scene import make_scene, with_parameters
from dln_jax.softbody.step import make_step, positions_and_convergence
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.loads import gravity
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean

jax.config.update("jax_enable_x64", True)

STEPS = 25
DT, NOISE = 0.02, 1e-3  # s, m
TRUTH = np.array([2e5, 4e4])  # Pa: near the clamp, and at the tip

# %%
# The scene
# ---------
# Each half of the tail has its own Young's modulus.

mesh = beam(0.5, 0.06, 10, 1)
tip = mesh.vertices[mesh.elements].mean(axis=1)[:, 0] > 0.25
terms = [elastic(mesh, stable_neo_hookean, poisson_ratio=0.4), gravity(mesh)]
scene = make_scene(mesh, terms, held=vertices_where(mesh, lambda x: x[:, 0] == 0.0))
stepper = make_step(scene, DT)
guess = jnp.log(jnp.array([1e5, 1e5]))


def params_of(theta):
    near, far = jnp.exp(theta)
    return with_parameters(scene.params, elastic={"youngs_modulus": jnp.where(tip, far, near)})


@jax.jit
def motion(theta, state):
    step = partial(stepper.step, params_of(theta))
    return rollout(step, state, steps=STEPS, observe=positions_and_convergence)[1]


# %%
# Observation and fit
# -------------------
# The positions have noise of 1 mm. The fit starts at 1e5 Pa for both halves.

start, other = stepper.init(), stepper.init(v=np.where(mesh.vertices[:, :1] > 0, [[0.0, 2.0]], 0.0))
x, converged = motion(jnp.log(TRUTH), start)
assert converged.all()
seen = x + NOISE * jax.random.normal(jax.random.key(0), x.shape)
fit = identify(stepper, params_of, guess, ObservedMotions(start.x[None], start.v[None], None, seen[None]), noise=NOISE)
found = np.exp(fit.parameters)
print(f"found {found[0]:.4g} and {found[1]:.4g} Pa; true {TRUTH[0]:.4g} and {TRUTH[1]:.4g} Pa")
assert np.abs(found / TRUTH - 1).max() < 0.02

actual, before, after = (motion(theta, other)[0] for theta in (jnp.log(TRUTH), guess, fit.parameters))
errors = [float(jnp.sqrt(jnp.mean(jnp.sum((at - actual) ** 2, axis=-1)))) for at in (before, after)]
print(f"error of a motion that was not fitted: {1e3 * errors[0]:.1f} mm before, {1e3 * errors[1]:.2f} mm after")
assert errors[1] < NOISE

# %%
# The figure shows the unseen motion: the tail at three moments, and the height of its tip.

figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3.4), layout="constrained", width_ratios=(1, 1))
for k, alpha in zip(np.linspace(STEPS // 5, STEPS - 1, 3).astype(int), (0.35, 0.65, 1.0), strict=True):
    left.add_collection(PolyCollection(np.asarray(actual[k])[mesh.elements], facecolor="0.75", alpha=alpha))
    for at, colour in ((before, style.ORANGE), (after, style.BLUE)):
        outline = np.asarray(at[k])[np.lexsort((mesh.vertices[:, 0], mesh.vertices[:, 1] > 0.03))]
        ends = np.split(outline, 2)
        left.plot(*np.concatenate([ends[0], ends[1][::-1]]).T, color=colour, linewidth=1.5, alpha=alpha)
left.set(aspect="equal", xlabel="x, m", ylabel="y, m")
t = DT * np.arange(1, STEPS + 1)
corner = int(np.argmax(mesh.vertices.sum(axis=1)))
right.plot(t, actual[:, corner, 1], color="0.6", linewidth=5, label="observed body")
right.plot(t, before[:, corner, 1], color=style.ORANGE, label="before the fit")
right.plot(t, after[:, corner, 1], color=style.BLUE, label="after the fit")
style.prepare(right)
right.set(xlabel="t, s", ylabel="height of the tip, m")
style.legend(right)
