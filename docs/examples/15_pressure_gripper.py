"""
A gripper closed by pressure
============================

Two soft fingers have chambers on their outer sides. Pressure stretches these sides, so that the fingers bend inwards.
They close around a ball on the ground and grip it below its middle, and friction holds it while the palm lifts the
fingers.

.. figure:: /gripper.gif
   :alt: Two fingers bend under pressure, close around a ball and lift it

   The film that this example writes, at 30 % of the speed.

The drawing of the film is in `slab_films.py`, which lies in the folder of this example.
"""

from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from slab_films import TOOL, Slab, write_slab_film

from dln_jax.figures import style
from dln_jax.rollout import rollout
from dln_jax.softbody.contact.bodies import body_contact
from dln_jax.softbody.contact.crossings import crossings
from dln_jax.softbody.contact.obstacles import half_space, obstacle_contact
from dln_jax.softbody.mesh.mesh import lumped_masses, make_mesh, values_by_set, vertices_where
from dln_jax.softbody.mesh.shapes import disc, join, lattice, translate
from dln_jax.softbody.mesh.surfaces import enclosed_volume, inner_surface, surface_parts
from dln_jax.softbody.scene import make_scene, potential
from dln_jax.softbody.step import Motion, make_step
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.loads import gravity, pressure
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean

jax.config.update("jax_enable_x64", True)

STEPS, RINGS = 64, 4
SECONDS = 1.6
CHAMBERS, CELL, RADIUS = 6, 2e-3, 20e-3  # cells and radius of the ball in m
DOWN, UP = 46e-3, 60e-3  # m
PRESSURE = 18e3  # Pa
LOWERED, CLOSED, LIFTED = 0.4, 0.9, 1.4  # s

# %%
# The bodies
# ----------
# A finger is a strip, 80 mm long and 4 mm thick, with six chambers on its outer side. A ball of soft foam lies on the
# ground, y = 0. Masses and forces are those of a body 1 m deep.

length = 6 * CHAMBERS + 4
strip = [(i, j) for i in range(2) for j in range(length)]
walls = [(i, j) for i in range(2, 8) for j in range(length - 4) if j % 6 in (0, 4) or (i == 7 and j % 6 < 4)]
positions, triangles = lattice(strip + walls)
positions = CELL * positions + np.array([1.7 * RADIUS, DOWN + 8e-3])
right, left = (make_mesh(positions * [side, 1.0], triangles) for side in (1.0, -1.0))
ball = translate(disc(RADIUS, RINGS), [0.0, RADIUS + 4e-4])
mesh = join(right, left, ball=ball)
masses = lumped_masses(mesh, values_by_set(mesh, 1000.0, {"ball": 200.0}))  # silicone and foam, kg/m³
top = mesh.vertices[:, 1].max()
roots, of_ball = vertices_where(mesh, lambda x: x[:, 1] > top - CELL / 2), mesh.sets["ball"].vertices

# %%
# The scene
# ---------
# `inner_surface` finds the walls of all chambers. Their pressure gets no value here, so it is the control of the steps.
# The friction between fingers and ball is higher than that on the ground.

terms = [
    elastic(mesh, stable_neo_hookean, youngs_modulus=3e5, poisson_ratio=0.4),
    gravity(mesh),
    pressure(mesh, inner_surface(mesh)),
]
near = {"distance": 8e-4, "stiffness": 2e4}
contacts = [
    body_contact(mesh, friction=0.8, **near),
    obstacle_contact(mesh, half_space([0.0, 1.0]), friction=0.1, name="ground", **near),
]
scene = make_scene(mesh, terms, masses=masses, held=roots, contacts=contacts)


# %%
# The motion
# ----------
# The palm holds the upper ends of the fingers. It lowers them, the pressure rises, and the palm lifts them and holds
# them.


def ramp(t, start, end):
    s = np.clip((t - start) / (end - start), 0.0, 1.0)
    return s * s * (3 - 2 * s)


def palm(t):
    return UP * ramp(t, CLOSED, LIFTED) - DOWN * ramp(t, 0.0, LOWERED)


def chamber_pressure(t):
    return PRESSURE * ramp(t, LOWERED, CLOSED)


dt = SECONDS / STEPS
t = dt * np.arange(1, STEPS + 1)
lifting = Motion(held=mesh.vertices[roots] + palm(t)[:, None, None] * np.array([0.0, 1.0]))
init, step = make_step(scene, dt)


@jax.jit
def motion(*inputs):
    observe = lambda state, info: (state.x, info.converged, info.least_distance)  # noqa: E731
    return rollout(lambda state, now: step(scene.params, state, *now), init(), inputs, observe=observe)[1]


x, converged, distances = map(np.asarray, motion(chamber_pressure(t), lifting))
x = np.concatenate([mesh.vertices[None], x])
shown = np.round(np.array([0.0, LOWERED, 0.5 * (LOWERED + CLOSED), CLOSED, SECONDS]) / dt).astype(int)
print(f"{converged.sum()} of {STEPS} steps converged; surfaces came within {1e3 * distances.min():.2f} mm")
assert converged.all()
assert not any(crossings(mesh, x[k]) for k in shown)

# %%
# The ball rises with the palm, and a little more because the fingers close below its middle. At the end everything is
# nearly at rest, so the palm carries the weights of the fingers and of the ball.

lifted = (x[-1] - x[0])[of_ball, 1].mean()
forces = jax.jit(jax.grad(lambda x: potential(scene, x, scene.params, PRESSURE)))(x[-1])
weight, own = 9.81 * masses[of_ball].sum(), 9.81 * np.delete(masses, of_ball).sum()
carried = forces[roots, 1].sum() - own
print(f"the ball was lifted by {1e3 * lifted:.1f} mm; it weighs {weight:.2f} N, and the palm carries {carried:.2f} N")
assert UP < lifted < UP + 5e-3
assert abs(carried / weight - 1) < 0.03

# %%
# In the film, darker parts of the fingers are stretched more, and the orange of the chambers deepens with their
# pressure.


def largest_stretch(corners, rest):
    now, before = (np.stack([at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]], axis=2) for at in (corners, rest))
    return np.linalg.svd(now @ np.linalg.inv(before), compute_uv=False)[:, 0]


def loop(wall):
    following, path = dict(wall.tolist()), [wall[0, 0]]
    while len(path) < len(wall):
        path.append(following[path[-1]])
    return path


chambers = [loop(part) for part in surface_parts(mesh) if enclosed_volume(mesh.vertices, part) < 0]
of_fingers, skin = mesh.elements[: 2 * len(triangles)], loop(surface_parts(ball)[0])
colours = LinearSegmentedColormap.from_list("stretch", ["#9CCBEB", style.BLUE, "#00213A"])
white, orange, green = (np.array(to_rgb(colour)) for colour in ("0.97", style.ORANGE, style.GREEN))


def paint(k):
    stretch = largest_stretch(x[k][of_fingers], mesh.vertices[of_fingers])
    return np.concatenate([colours((stretch - 1) / 0.3)[:, :3], np.tile(green, (len(ball.elements), 1))])


def palm_and_chambers(k):
    p, low = chamber_pressure(k * dt) / PRESSURE, top + palm(k * dt)
    bar = np.array([(-0.06, low), (0.06, low), (0.06, low + 7e-3), (-0.06, low + 7e-3)])
    return [Slab(bar, TOOL), *(Slab(x[k][path][::-1], p * orange + (1 - p) * white) for path in chambers)]


write_slab_film(
    Path("gripper.gif"),
    mesh,
    x,
    dt * np.arange(len(x)),
    depth=0.03,
    ground=np.array([(-0.075, 0.0), (0.085, 0.0)]),
    colours=paint,
    slabs=palm_and_chambers,
    label=lambda k: f"{1e-3 * chamber_pressure(k * dt):.0f} kPa",
    window=((-0.075, 0.085), (-0.012, 0.175)),
    width=4.2,
    frames_per_second=12.0,
)

# %%
# The figure shows the same at five moments.

figure, panels = plt.subplots(1, 5, figsize=(7.5, 2.9), sharex=True, sharey=True, layout="constrained")
for axes, k in zip(panels, shown, strict=True):
    p, at = chamber_pressure(k * dt), 1e3 * x[k]
    axes.axhspan(-8, 0, color="0.8")
    axes.add_patch(plt.Rectangle((-60, 1e3 * (top + palm(k * dt))), 120, 7, color="0.35"))
    fill = {"facecolor": style.ORANGE, "alpha": p / PRESSURE}
    axes.add_collection(PolyCollection([at[path] for path in chambers], **fill))
    axes.add_patch(plt.Polygon(at[of_ball][skin], color=style.GREEN))
    stretch = largest_stretch(x[k][of_fingers], mesh.vertices[of_fingers])
    fingers = PolyCollection(at[of_fingers], array=stretch, cmap=colours, edgecolor="face", linewidth=0.3)
    fingers.set_clim(1.0, 1.3)
    axes.add_collection(fingers)
    axes.set(xlim=(-63, 63), ylim=(-8, 158), aspect="equal")
    axes.set_title(f"{k * dt:.2f} s, {1e-3 * p:.0f} kPa", fontsize=9)
    axes.set_axis_off()
bar = figure.colorbar(fingers, ax=panels, orientation="horizontal", shrink=0.4, aspect=30, pad=0.02)
bar.set_label("largest stretch of each element", fontsize=9)
bar.ax.tick_params(labelsize=8)
