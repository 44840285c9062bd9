"""
Your own mesh
=============

A coil spring hangs from its upper end, and its lower half is of a softer rubber. It comes from a mesh file in
millimetres, whose named sets state which vertices are held and where each material is.
"""

import tempfile
from functools import partial
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LightSource, to_rgb
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from dln_jax.figures import style
from dln_jax.rollout import rollout
from dln_jax.softbody.mesh.files import read_mesh, write_motion
from dln_jax.softbody.mesh.mesh import boundary, values_by_set, vertices_in
from dln_jax.softbody.mesh.shapes import lattice
from dln_jax.softbody.scene import make_scene
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.loads import gravity
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean

jax.config.update("jax_enable_x64", True)

STEPS, TURNS, SEGMENTS = 20, 5, 16
DT = 0.02  # s
folder = Path(tempfile.mkdtemp())

# %%
# The file
# --------
# Gmsh writes such a file, and so does any mesher that saves .vtk, .vtu, .obj or TetGen's .ele. This file is in Gmsh's
# format 2.2. It has nodes, tetrahedra, and the physical group of each tetrahedron: "clamp", "stiff" or "soft".

length = TURNS * SEGMENTS
positions, tetrahedra = lattice([(i, j, k) for i in range(length) for j in range(2) for k in range(2)])
angle, radius = 2 * np.pi * positions[:, 0] / SEGMENTS, 40 + 5.0 * positions[:, 1]
height = 5.0 * positions[:, 2] - 14 * positions[:, 0] / SEGMENTS
nodes = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
place = positions[tetrahedra][:, :, 0].mean(axis=1)
group = 1 + (place > 1).astype(int) + (place > length / 2)
names = "".join(f'3 {number} "{name}"\n' for number, name in ((1, "clamp"), (2, "stiff"), (3, "soft")))
rows = [f"{i} {x} {y} {z}" for i, (x, y, z) in enumerate(nodes, 1)]
cells = [f"{i} 4 2 {group[i - 1]} 1 {' '.join(map(str, cell + 1))}" for i, cell in enumerate(tetrahedra, 1)]
(folder / "coil.msh").write_text(
    f"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$PhysicalNames\n3\n{names}$EndPhysicalNames\n"
    f"$Nodes\n{len(rows)}\n{chr(10).join(rows)}\n$EndNodes\n"
    f"$Elements\n{len(cells)}\n{chr(10).join(cells)}\n$EndElements\n"
)

# %%
# The body
# --------
# `read_mesh` returns the mesh in metres, and a line for everything that it left out or repaired.

mesh, statements = read_mesh(folder / "coil.msh", scale=1e-3)
for name, part in mesh.sets.items():
    print(f"{name}: {len(part.vertices)} vertices, {len(part.elements)} elements")
for statement in (*statements, f"{mesh.turned} elements were inverted and have been turned"):
    print(statement)

modulus = values_by_set(mesh, 4e6, {"soft": 1.5e6})
terms = [elastic(mesh, stable_neo_hookean, youngs_modulus=modulus, poisson_ratio=0.4), gravity(mesh)]
scene = make_scene(mesh, terms, held=vertices_in(mesh, ["clamp"]))

# %%
# The motion
# ----------
# The spring is let go. You can open `motion.pvd` in ParaView; it has velocities, volume ratios and the named sets. In
# the picture the clamp is dark, the stiff half blue and the soft half orange.

init, step = make_step(scene, DT)
observe = lambda state, info: (state.x, state.v, info.converged)  # noqa: E731
x, v, converged = jax.jit(lambda: rollout(partial(step, scene.params), init(), steps=STEPS, observe=observe)[1])()
assert converged.all() and np.allclose(x[-1][scene.held], mesh.vertices[scene.held])
write_motion(folder / "motion.pvd", mesh, DT * np.arange(1, STEPS + 1), np.asarray(x), np.asarray(v))

x = np.concatenate([mesh.vertices[None], x])
lowest = x[:, :, 2].min(axis=1)
shown = np.linspace(0, lowest.argmin(), 4).astype(int)
print(
    f"the spring is {-1e3 * lowest[0]:.0f} mm long, and {-1e3 * lowest.min():.0f} mm after {DT * lowest.argmin():.2f} s"
)
assert lowest.min() < lowest[0] - 0.01

skin, colours = boundary(mesh), np.full((len(mesh.vertices), 3), 0.3)
for name, colour in (("stiff", style.BLUE), ("soft", style.ORANGE)):
    colours[np.setdiff1d(mesh.sets[name].vertices, scene.held)] = to_rgb(colour)
figure = plt.figure(figsize=(7.2, 4.6))
axes = figure.add_axes((-0.15, -0.55, 1.3, 2), projection="3d", computed_zorder=False)
for column, k in enumerate(shown):
    corners, looks = x[k][skin] + [0.0, 0.15 * column, 0.0], colours[skin].mean(axis=1)
    axes.add_collection3d(Poly3DCollection(corners, facecolors=looks, shade=True, lightsource=LightSource(250, 50)))
    axes.text(0.0, 0.15 * column, 0.03, f"{DT * k:.2f} s", ha="center")
for row, (text, colour) in enumerate({"clamp": "0.3", "stiff half": style.BLUE, "soft half": style.ORANGE}.items()):
    axes.text(0.0, -0.05, -0.14 - 0.022 * row, text, color=colour)
depth = 1.05 * lowest.min()
axes.set(xlim=(-0.06, 0.06), ylim=(-0.05, 0.5), zlim=(depth, 0.04))
axes.set_box_aspect((0.12, 0.55, 0.04 - depth), zoom=0.84)
axes.view_init(elev=12, azim=10)
axes.set_axis_off()
