"""
A measured pendulum with friction
=================================

A camera measures times and noisy angles of a swinging pendulum, but no rates and no torques. The command
`train_hnn_task` matches motions through an integrator, so that no noise is differentiated, and separates energy from
friction.
"""

import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dln_jax
from dln_jax.commands import train_hnn_task
from dln_jax.figures import style
from dln_jax.mechanics.integrators import rk4, rollout
from dln_jax.runs.arguments import arguments_of

jax.config.update("jax_enable_x64", True)

NOISE = 0.01  # rad
FRICTION = 0.15  # 1/s
STIFFNESS = 9.0  # g / l, 1/s²
ITERATIONS = 15

# %%
# The measurement
# ---------------
# There are six recordings of 6 s at 20 Hz. The file has only the measurements: `t`, `q` and the index of the recording.

times = np.arange(0, 6, 0.05)
starts = np.random.default_rng(0).uniform(0.3, 2.0, 6)


def swing(t, state):
    q, qd = state
    return qd, -STIFFNESS * jnp.sin(q) - FRICTION * qd


motion = jax.jit(jax.vmap(lambda start: rollout(rk4(swing), (start, 0.0 * start), times, substeps=4)))
angles, rates = motion(starts)
measured = np.asarray(angles) + NOISE * np.random.default_rng(1).normal(size=angles.shape)
folder = Path(tempfile.mkdtemp())
np.savez(
    folder / "pendulum.npz",
    t=np.tile(times, len(starts)),
    q=measured.reshape(-1, 1),
    trajectory=np.repeat(np.arange(len(starts)), len(times)),
)

# %%
# Training
# --------
# In a terminal, the same command is
#
# `dln-jax train_hnn_task --task measured --data pendulum.npz --needs '{"joints": ["revolute"], "friction": true}'`
#
# A revolute joint enters as cosine and sine. `"friction": true` adds a dissipation to the model.

train_hnn_task.main(
    arguments_of(
        train_hnn_task.Arguments,
        task="measured",
        data=folder / "pendulum.npz",
        needs='{"joints": ["revolute"], "friction": true}',
        steps=ITERATIONS,
        out=folder / "run",
        figures=False,
    )
)
flow = dln_jax.load(folder / "run").flow

# %%
# Friction takes the energy
# -------------------------
# The energy falls by dH/dt = -2 D, where D is the Rayleigh function. Here the learned model swings from a start that
# was not measured.

start = jnp.array([1.5]), jnp.array([0.0])
q, p = jax.jit(lambda start: rollout(rk4(lambda t, state: flow.rates(*state)), start, times, substeps=4))(start)
energy = jax.vmap(flow.energy)(q, p)
assert energy[-1] < energy[0]

true_q, _ = motion(np.array([1.5]))
error = float(np.sqrt(np.mean((q[:, 0] - true_q[0]) ** 2)))
print(f"a new swing of 6 s: root mean square error {error:.4f} rad; the noise of the data was {NOISE} rad")
assert error < 5 * NOISE

# %%
# The first figure shows the first swing as the camera would see it, with learned rods from pale to dark and the true
# positions as rings.

swing_back = slice(0, int(np.argmin(true_q[0][:40])) + 1)
figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
seen, exact = np.asarray(q[swing_back, 0]), np.asarray(true_q[0][swing_back])
for angle, alpha in zip(seen, np.linspace(0.15, 1, len(seen)), strict=True):
    axes.plot([0, np.sin(angle)], [0, -np.cos(angle)], color="#3b4252", linewidth=3, alpha=alpha)
    axes.plot(np.sin(angle), -np.cos(angle), "o", color=style.VERMILLION, markersize=15, alpha=alpha)
axes.plot(np.sin(exact), -np.cos(exact), "o", color="black", fillstyle="none", markersize=17, label="truth")
axes.plot(0, 0, "o", color="#3b4252", markersize=9)
axes.set(aspect="equal", xlim=(-1.25, 1.25), ylim=(-1.25, 0.15))
axes.set_axis_off()
style.legend(axes, loc="lower right")

# %%
# The second figure shows the whole motion, and the learned energy along it.

figure, (above, below) = plt.subplots(2, 1, figsize=(7, 4.5), sharex=True, layout="constrained")
style.prepare(above, below)
above.plot(times, true_q[0], "k", linewidth=3, label="truth")
above.plot(times, q[:, 0], "--", color=style.VERMILLION, label="learned")
above.set(ylabel="angle, rad")
style.legend(above, ncols=2)
below.plot(times, energy - energy.min(), color=style.VERMILLION)
below.set(ylabel="learned energy", xlabel="time, s")
