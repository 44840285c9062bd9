"""
Bodies that touch
=================

A soft band is let go above a round peg. It drapes over the peg, and its ends land on the ground, fold and slide.
Barriers keep all surfaces apart. The example checks this in exact arithmetic.
"""

from functools import partial

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import PolyCollection

from dln_jax.figures import style
from dln_jax.rollout import rollout
from dln_jax.softbody.contact.bodies import body_contact
from dln_jax.softbody.contact.crossings import crossings
from dln_jax.softbody.contact.obstacles import half_space, obstacle_contact, sphere
from dln_jax.softbody.mesh.shapes import beam
from dln_jax.softbody.scene import make_scene
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.loads import gravity
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean

jax.config.update("jax_enable_x64", True)

STEPS, CELLS = 140, 40
DT = 0.01  # s

# %%
# The scene
# ---------
# The band is a mesh in contact with itself. The peg and the ground are rigid obstacles with friction. Surfaces repel
# each other at distances below 8 mm.

mesh = beam(1.2, 0.03, CELLS, 1)
mesh = mesh._replace(vertices=mesh.vertices + np.array([-0.5, 0.45]))
terms = [elastic(mesh, stable_neo_hookean, youngs_modulus=4e4, poisson_ratio=0.3), gravity(mesh)]
near = {"distance": 8e-3, "stiffness": 1e4, "friction": 0.3}
contacts = [
    body_contact(mesh, **near),
    obstacle_contact(mesh, sphere([0.0, 0.25], 0.12), name="peg", **near),
    obstacle_contact(mesh, half_space([0.0, 1.0]), name="ground", **near),
]
scene = make_scene(mesh, terms, contacts=contacts)

# %%
# The motion
# ----------
# Each step reports whether it converged, how near surfaces came, and whether the lists of near pairs were long enough.

init, step = make_step(scene, DT)
observe = lambda state, info: (state.x, info.converged, info.least_distance, info.overflow)  # noqa: E731
motion = jax.jit(lambda: rollout(partial(step, scene.params), init(), steps=STEPS, observe=observe)[1])()
x, converged, distances, overflow = map(np.asarray, motion)
print(f"{converged.sum()} of {STEPS} steps converged; surfaces came within {1e3 * distances.min():.1f} mm")
assert converged.all() and not overflow.any()
assert not any(crossings(mesh, at) for at in x)

# %%
# The figure shows the band at four moments.

figure, panels = plt.subplots(2, 2, figsize=(7.2, 4.2), sharex=True, sharey=True, layout="constrained")
every = np.concatenate([mesh.vertices[None], x])
for axes, k in zip(panels.ravel(), np.linspace(0, STEPS, 4).astype(int), strict=True):
    axes.add_patch(plt.Circle((0.0, 0.25), 0.12, color="0.7"))
    axes.axhspan(-0.06, 0.0, color="0.8")
    axes.add_collection(
        PolyCollection(every[k][mesh.elements], facecolor=style.BLUE, edgecolor=style.BLUE, linewidth=1.0)
    )
    axes.set(xlim=(-0.55, 0.75), ylim=(-0.06, 0.52), aspect="equal")
    style.title(axes, f"{DT * k:.2f} s")
    axes.set_axis_off()
    axes.plot([0.5, 0.7], [0.2, 0.2], color="0.2", linewidth=2)
    axes.text(0.6, 0.22, "0.2 m", ha="center", fontsize=style.SMALL)
