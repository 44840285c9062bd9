"""
Down the stairs
===============

A body from a mesh file falls down stairs. The stairs are rigid boxes with friction. Barriers, which no step crosses,
keep the body away from the stairs and from itself.

.. figure:: /stairs.gif
   :alt: A soft ellipse tumbles down stairs

   The film that this example writes, at a third of the speed.

The drawing of the film is in `slab_films.py`, which lies in the folder of this example.
"""

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import PolyCollection
from slab_films import write_slab_film

from dln_jax.figures import style
from dln_jax.rollout import rollout
from dln_jax.softbody.contact.bodies import body_contact
from dln_jax.softbody.contact.crossings import crossings
from dln_jax.softbody.contact.obstacles import box, obstacle_contact
from dln_jax.softbody.mesh.files import read_mesh, write_mesh
from dln_jax.softbody.mesh.mesh import make_mesh
from dln_jax.softbody.mesh.shapes import disc
from dln_jax.softbody.scene import make_scene
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.loads import gravity
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean

jax.config.update("jax_enable_x64", True)

STEPS, DT = 150, 0.01  # s
RISE, RUN, COUNT = 0.15, 0.4, 3  # m

# %%
# The body
# --------
# Any mesh file that `read_mesh` accepts will do. This one is an elliptic disc, written here.

with TemporaryDirectory() as folder:
    path, drawn = Path(folder) / "body.vtu", disc(0.16, 5)
    write_mesh(path, make_mesh(drawn.vertices * [1.3, 0.8] + [0.1, 0.35 + COUNT * RISE], drawn.elements))
    mesh, statements = read_mesh(path)
print(*statements, sep="\n")

# %%
# The stairs
# ----------
# Each stair is a box down to the ground. The boxes repel vertices at distances below 8 mm.

near = {"distance": 8e-3, "stiffness": 1e4, "friction": 0.3}
tops = [(COUNT - k) * RISE for k in range(COUNT + 1)]  # the last is the ground
lefts = [-0.4, *(0.3 + RUN * k for k in range(COUNT))]
rights = [*lefts[1:], lefts[-1] + 1.6]
stairs = [
    obstacle_contact(
        mesh,
        box([(left + right) / 2, top - 0.5], [(right - left) / 2, 0.5]),
        name=f"stair {number}",
        **near,
    )
    for number, (left, right, top) in enumerate(zip(lefts, rights, tops, strict=True))
]
terms = [elastic(mesh, stable_neo_hookean, youngs_modulus=5e4, poisson_ratio=0.3), gravity(mesh)]
scene = make_scene(mesh, terms, contacts=[body_contact(mesh, **near), *stairs])

# %%
# The motion
# ----------
# The body starts at 1.5 m/s to the right.

init, step = make_step(scene, DT)
observe = lambda state, info: (state.x, info.converged, info.least_distance)  # noqa: E731
start = init(v=(1.5, 0.0))
x, converged, distances = map(
    np.asarray, jax.jit(lambda: rollout(partial(step, scene.params), start, steps=STEPS, observe=observe)[1])()
)
print(f"{converged.sum()} of {STEPS} steps converged; surfaces came within {1e3 * distances.min():.1f} mm")
assert converged.all()
assert not any(crossings(mesh, at) for at in x[::10])

# %%
# The film shows the body as a slab, with its shadow.

every = np.concatenate([mesh.vertices[None], x])
line = np.stack([np.stack([lefts, rights], axis=1).ravel(), np.repeat(tops[: len(lefts)], 2)], axis=1)
line[[0, -1], 0] = -0.25, 1.75
write_slab_film(
    Path("stairs.gif"),
    mesh,
    every,
    DT * np.arange(len(every)),
    depth=0.22,
    ground=line,
    window=((-0.25, 1.75), (-0.14, 1.0)),
    stride=2,
    frames_per_second=50 / 3,
)

# %%
# The figure shows four moments of the fall, the earliest palest, with the shadows on the stairs.

figure, axes = plt.subplots(figsize=(7, 3.6), layout="constrained")
for left, right, top in zip(lefts, rights, tops, strict=True):
    axes.add_patch(plt.Rectangle((left, -0.1), right - left, top + 0.1, color="0.82", linewidth=0))
for k in np.linspace(0, STEPS, 4).astype(int):
    alpha = 0.25 + 0.75 * k / STEPS
    corners = every[k]
    shadow = corners[:, 0].min(), corners[:, 0].max()
    for left, right, top in zip(lefts, rights, tops, strict=True):
        if (ends := np.clip(shadow, left, right))[0] < ends[1]:
            axes.plot(ends, [top, top], color="0.55", linewidth=3, alpha=alpha, solid_capstyle="butt")
    axes.add_collection(
        PolyCollection(corners[mesh.elements], facecolor=style.BLUE, edgecolor="white", linewidth=0.3, alpha=alpha)
    )
    axes.text(corners[:, 0].mean(), corners[:, 1].max() + 0.02, f"{DT * k:.2f} s", ha="center", fontsize=8)
axes.set(xlim=(lefts[0] + 0.1, rights[-1] - 0.9), ylim=(-0.1, 1.1), aspect="equal")
axes.set_axis_off()
