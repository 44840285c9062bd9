"""
A tangle
========

Soft strips fall into a bin, onto each other, and bend into a heap. Barriers keep strips from crossing each other and
themselves. The example checks this in exact arithmetic.

.. figure:: /tangle.gif
   :alt: Five soft strips fall into a bin and fold into a heap

   The film that this example writes, at 40 % of the speed.

The drawing of the film is in `slab_films.py`, which lies in the folder of this example.
"""

from functools import partial
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import PolyCollection
from slab_films import write_slab_film

from dln_jax.rollout import rollout
from dln_jax.softbody.contact.bodies import body_contact
from dln_jax.softbody.contact.crossings import crossings
from dln_jax.softbody.contact.obstacles import half_space, obstacle_contact
from dln_jax.softbody.mesh.shapes import beam, join, rotate, translate
from dln_jax.softbody.scene import make_scene
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.elasticity import elastic, mass_damping
from dln_jax.softbody.terms.loads import gravity
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean

jax.config.update("jax_enable_x64", True)

STEPS, STRIPS = 160, 5
DT, WIDTH = 0.01, 0.3  # s, m

# %%
# The scene
# ---------
# The strips are longer than the bin is wide, so they have to bend. Bin and ground are rigid obstacles.

strip = beam(0.5, 0.02, 20, 1)
random = np.random.default_rng(1)
strip = translate(strip, -strip.vertices.mean(axis=0))
mesh = join(
    *(
        translate(rotate(strip, np.pi / 2 + random.uniform(-0.05, 0.05)), [WIDTH * (k + 0.5) / STRIPS, 0.35 + 0.05 * k])
        for k in range(STRIPS)
    )
)
terms = [
    elastic(mesh, stable_neo_hookean, youngs_modulus=5e4, poisson_ratio=0.3),
    gravity(mesh),
    mass_damping(mesh, rate=1.0),
]
near = {"distance": 6e-3, "stiffness": 1e4, "friction": 0.3}
walls = {"left": half_space([1.0, 0.0]), "right": half_space([-1.0, 0.0], -WIDTH), "ground": half_space([0.0, 1.0])}
contacts = [
    body_contact(mesh, **near),
    *(obstacle_contact(mesh, wall, name=name, **near) for name, wall in walls.items()),
]
scene = make_scene(mesh, terms, contacts=contacts)

# %%
# The motion
# ----------

init, step = make_step(scene, DT)
observe = lambda state, info: (state.x, info.converged, info.least_distance, info.overflow)  # noqa: E731
motion = jax.jit(lambda: rollout(partial(step, scene.params), init(), steps=STEPS, observe=observe)[1])()
x, converged, distances, overflow = map(np.asarray, motion)
print(f"{converged.sum()} of {STEPS} steps converged; surfaces came within {1e3 * distances.min():.2f} mm")
assert converged.all() and not overflow.any()
assert not any(crossings(mesh, at) for at in x[::10])

# %%
# In the film every strip has its own colour, and walls are drawn as high as strips touch them.

every = np.concatenate([mesh.vertices[None], x])
colours = plt.get_cmap("viridis")(np.linspace(0.1, 0.9, STRIPS))[:, :3]
shades = np.repeat(colours, len(strip.elements), axis=0)
high, thick = 0.45, 0.03
line = [(-thick, high), (0, high), (0, 0), (WIDTH, 0), (WIDTH, high), (WIDTH + thick, high)]
write_slab_film(
    Path("tangle.gif"),
    mesh,
    every,
    DT * np.arange(len(every)),
    depth=0.08,
    ground=np.array(line),
    colours=shades,
    window=((-0.06, WIDTH + 0.08), (-0.05, 0.86)),
    width=3.2,
    stride=2,
)

# %%
# The figure shows the heap at four moments.

figure, panels = plt.subplots(1, 4, figsize=(9, 4.4), sharey=True, layout="constrained")
for axes, k in zip(panels, np.linspace(0, STEPS, 4).astype(int), strict=True):
    axes.fill(
        [-0.03, 0.0, 0.0, WIDTH, WIDTH, WIDTH + 0.03, WIDTH + 0.03, -0.03],
        [0.9, 0.9, 0, 0, 0.9, 0.9, -0.03, -0.03],
        color="0.75",
    )
    axes.add_collection(PolyCollection(every[k][mesh.elements], facecolor=shades, edgecolor=shades, linewidth=0.5))
    axes.set(xlim=(-0.04, WIDTH + 0.04), ylim=(-0.04, 0.9), aspect="equal", title=f"{DT * k:.2f} s")
    axes.set_axis_off()
