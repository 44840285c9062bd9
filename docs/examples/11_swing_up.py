"""
A swing-up in a minute
======================

A motor turns an arm, and a free pole hangs at its end. The energy of the machine is all you need for a law that swings
the pole up, a regulator that holds it there, and the set of states from which the regulator can take over.
"""

import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dln_jax
from dln_jax.control.closed_loop import Hardware, simulate, stateless
from dln_jax.control.energy_shaping import EnergyGains, energy_shaping, parts_of
from dln_jax.control.regulators import lqr, region_of_attraction, regulated, switched, value
from dln_jax.control.state_space import error, field_of, holding_controls, linearise
from dln_jax.figures import style
from dln_jax.figures.closed_loops import angle_ticks, rotary_pendulum_drawing, write_closed_loop_gif
from dln_jax.scenes.pendulums import rotary_pendulum

jax.config.update("jax_enable_x64", True)

STARTS, FRAMES_PER_SECOND = 30, 25.0
LIMIT = 0.05  # N m

# %%
# The machine
# -----------
# The coordinates are the angle of the arm and the angle of the pole from upright. Only the arm is driven.

scene = rotary_pendulum(friction=1e-5)
plant, B, joints = dln_jax.dynamics(scene.energies), np.array(scene.needs.actuation), scene.needs.joints
field, goal = field_of(plant, B), jnp.zeros(4)

# %%
# Holding it up
# -------------
# A linear-quadratic regulator holds the pole. Simulations with the motor's limit give the largest ellipsoid that it
# stabilises.

at = linearise(jax.jit(field), goal, holding_controls(plant, goal[:2], B))
regulator = lqr(at.A, at.B, Q=np.diag([1, 1, 0.01, 0.01]), R=[[50.0]])
near = regulated(regulator, goal, at.u, joints)
levels = 10.0 ** np.arange(-2, 1.01, 0.1)
region = region_of_attraction(
    field, near, regulator, goal, joints, lower=-LIMIT, upper=LIMIT, rate=500.0, levels=levels, starts=32
)
print(f"the regulator stabilises states whose value is below {region.level:.3g}")

# %%
# Swinging it up
# --------------
# The law drives the energy of the pole to that of the upright posture. The regulator takes over within its region.

swing = energy_shaping(plant, parts_of(B), goal[:2], EnergyGains(2e7, 20.0, 5.0))
law = switched(lambda x: swing(x[:2], x[2:]), near, value(regulator, goal, joints), region.level)
hardware = Hardware(-LIMIT, LIMIT, delay=1)
starts = np.zeros((STARTS, 4))
starts[:, 1] = np.pi + 0.2 * np.random.default_rng(0).normal(size=STARTS)
runs = jax.jit(
    jax.vmap(lambda x: simulate(field, stateless(law), x, seconds=4.0, rate=500.0, controls=1, hardware=hardware))
)(starts)
off = np.abs(jax.vmap(lambda x: error(x, goal, joints))(runs.x[:, -1])[:, 1])
print(f"{np.sum(off < 0.05)} of {STARTS} starts are up after 4 s; largest torque {np.abs(runs.u).max():.3f} N m")
assert (off < 0.05).all() and np.abs(runs.u).max() <= LIMIT

# %%
# The film and the phase plane
# ----------------------------
# The figure shows the first run at four moments, with the trace of the pole's tip.

folder, t, torque = Path(tempfile.mkdtemp()), np.asarray(runs.t[0, :-1]), np.asarray(runs.u[:, :, 0])
drawing = rotary_pendulum_drawing(0.085, 0.129)
figure, axes = plt.subplots(1, 4, figsize=(9, 3), layout="constrained")
for axis, moment in zip(axes, (0.05, 0.6, 1.2, 3.0), strict=True):
    drawing(axis, np.asarray(runs.x[0, :-1, :2]), 150)(int(500 * moment))
    style.title(axis, f"{moment:.2f} s")
write_closed_loop_gif(
    folder / "rotary-pendulum.gif",
    drawing,
    t,
    runs.x[0, :-1, :2],
    torque[0],
    limits=(-LIMIT, LIMIT),
    unit="N m",
    frames_per_second=FRAMES_PER_SECOND,
)
print(f"the film is in {folder}")

# %%
# Grey levels show the pole's energy with the arm at rest. On the dashed level the pole comes up by itself. The
# regulator takes over in the green ellipse.

angles, rates = np.linspace(-np.pi, np.pi, 121), np.linspace(-30, 30, 101)
resting = jax.vmap(lambda angle, rate: plant.energy(jnp.array([0.0, angle]), jnp.array([0.0, rate])))
states = [grid.ravel() for grid in np.meshgrid(angles, rates)]
levels = np.asarray(jax.jit(resting)(*states)).reshape(len(rates), len(angles))
sizes, directions = np.linalg.eigh(np.asarray(regulator.S[1::2, 1::2]))
turn = np.linspace(0, 2 * np.pi, 100)
caught = directions @ (np.sqrt(region.level / sizes)[:, None] * np.stack([np.cos(turn), np.sin(turn)]))
pole, speed = np.asarray(runs.x[:, :, 1]), np.asarray(runs.x[:, :, 3])
pole = np.arctan2(np.sin(pole), np.cos(pole))
jumps = np.abs(np.diff(pole, axis=1, prepend=pole[:, :1])) > np.pi  # where the wrapped angle leaps by a full turn
portrait, axis = plt.subplots(figsize=(7.2, 4.2), layout="constrained")
axis.contourf(angles, rates, levels, levels=18, cmap="Greys", alpha=0.35)
upright = [float(plant.energy(goal[:2], goal[2:]))]
axis.contour(angles, rates, levels, levels=upright, colors="0.25", linestyles="--", linewidths=1.2)
axis.plot(np.where(jumps, np.nan, pole)[1:].T, speed[1:].T, color=style.SKY, linewidth=0.7, alpha=0.6)
axis.plot(np.where(jumps, np.nan, pole)[0], speed[0], color=style.BLUE, linewidth=1.8)
axis.plot(pole[:, 0], speed[:, 0], "o", color=style.BLUE, markersize=3)
axis.fill(*caught, color=style.GREEN, alpha=0.45, zorder=4)
style.prepare(axis)
axis.grid(False)
look = {"ha": "center", "fontsize": style.TEXT, "arrowprops": {"arrowstyle": "-"}}
axis.annotate("the regulator takes over", (0.0, 0.0), (0.0, 15.0), **look)
axis.annotate("energy of upright", (-2.3, -19.5), (-1.9, -25.0), **look)
axis.set(xlim=(-np.pi, np.pi), xlabel="pole's angle from upright, rad", ylabel="rate, rad/s")
angle_ticks(axis.xaxis)

# %%
# The last figure shows angles and torques over time, for all starts.

figure, (above, below) = plt.subplots(2, 1, figsize=(7, 4), sharex=True, layout="constrained")
style.prepare(above, below)
above.plot(t, runs.x[:, :-1, 1].T / (2 * np.pi), color=style.BLUE, linewidth=0.6)
above.set(ylabel="pole, turns from upright")
below.plot(t, torque.T, color=style.BLUE, linewidth=0.4)
for limit in (-LIMIT, LIMIT):
    below.axhline(limit, color=style.VERMILLION)
below.set(xlabel="t, s", ylabel="torque, N m")
