"""
A soft body falls, and its gradient
===================================

A disc of rubber is thrown onto the ground. Each time step minimises inertia plus energies. The whole fall is
differentiable with respect to material, friction, masses and the shape at rest.
"""

from functools import partial

import jax
import numpy as np

from dln_jax.figures.soft_bodies import Moments, moments_figure
from dln_jax.rollout import rollout
from dln_jax.softbody.mesh.shapes import disc
from dln_jax.softbody.scene import make_scene, with_parameters
from dln_jax.softbody.step import make_step, positions_and_convergence
from dln_jax.softbody.terms.contact import plane_contact
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.loads import gravity
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean

jax.config.update("jax_enable_x64", True)

STEPS, RINGS = 60, 5

# %%
# The scene
# ---------
# A body is a mesh and a list of energy terms. Terms that a scene does not list are never compiled.

mesh = disc(radius=0.5, rings=RINGS)
ground = plane_contact(range(len(mesh.vertices)), normal=(0, 1), offset=-0.6, stiffness=1e6, width=1e-3, friction=0.4)
scene = make_scene(mesh, [elastic(mesh, stable_neo_hookean, youngs_modulus=1e5), gravity(mesh), ground])
init, step = make_step(scene, dt=0.01)

# %%
# The fall
# --------
# `rollout` returns the positions after each step, and whether each step found its minimum.


@jax.jit
def fall(params):
    start = init(v=(3.0, 0.0))  # thrown to the right, in m/s
    return rollout(partial(step, params), start, steps=STEPS, observe=positions_and_convergence)[1]


x, converged = fall(scene.params)
assert converged.all()
print(f"lowest point {float(x[..., 1].min()):+.4f} m; the ground is at -0.6 m")

shown = np.linspace(0, STEPS - 1, 4).astype(int)
above_ground = np.asarray(x[shown]) + np.array([0.0, 0.6])
figure = moments_figure([Moments("thrown to the right", mesh, above_ground, 0.01 * (shown + 1), ground=0.0)], columns=1)

# %%
# The gradient
# ------------
# A difference quotient checks the derivative of the distance with respect to the coefficient of friction.


def distance(params):
    return fall(params)[0][-1, :, 0].mean()


value, slope = jax.jit(jax.value_and_grad(distance))(scene.params)
by_friction = float(slope.terms["ground"].friction)
width = 1e-4
below, above = (distance(with_parameters(scene.params, ground={"friction": 0.4 + w})) for w in (-width, width))
difference = float(above - below) / (2 * width)
print(f"distance {float(value):.4f} m; derivative {by_friction:+.5f} m, difference quotient {difference:+.5f} m")
assert abs(by_friction - difference) < 1e-4 * abs(difference) + 1e-6
