"""
From an encoder log to C
========================

The log of a three-axis arm with known frames has noisy encoders, noisy torques, dry friction and no rates. This example
filters it, identifies the arm with its friction, estimates the uncertainty of the torques, and exports C for the
control loop.
"""

import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dln_jax
from dln_jax.data.encoders.smoothing import smooth
from dln_jax.data.schema import from_arrays
from dln_jax.data.splits import select
from dln_jax.figures import style
from dln_jax.identification.identify import identify
from dln_jax.learning import uncertainty
from dln_jax.learning.friction import fit_friction
from dln_jax.learning.linear import parameters_of
from dln_jax.mechanics.trees.description import dh_frames, serial
from dln_jax.mechanics.trees.frames import world_frames
from dln_jax.mechanics.trees.inertia import inertial_parameters
from dln_jax.models.trees import make_rigid_tree
from dln_jax.models.uncertainty import predictive

jax.config.update("jax_enable_x64", True)
random = np.random.default_rng(0)

# %%
# The arm
# -------
# Denavit-Hartenberg rows describe the frames. The masses of the links are unknown. The true arm has motors and
# friction.

rows = [[0, 0, 0.3, 0], [-np.pi / 2, 0, 0, 0], [0, 0.4, 0, 0]]  # alpha, a, d, theta
guess = serial(*dh_frames(rows), [inertial_parameters(1.0, np.zeros(3), 0.01 * np.eye(3))] * 3)
bodies = [inertial_parameters(mass, [0.15, 0.02, 0.03], np.diag([0.01, 0.03, 0.03]) * mass) for mass in (4.0, 3.0, 1.5)]
true = guess._replace(inertias=np.stack(bodies), armature=np.array([0.2, 0.2, 0.1]))
friction = dln_jax.joint_dissipation([0.5, 0.6, 0.3], [0.8, 1.0, 0.4], velocity_scale=0.03)
plant = dln_jax.dynamics(dln_jax.tree_system(true, friction))

# %%
# The log
# -------
# The log has five motions of 6 s at 125 Hz. Encoders have 0.1 mrad of noise, torques 0.2 N m; velocities are not
# logged.


def motion(amplitudes, phases, t):
    """Three harmonics for each joint, rad, and their derivatives."""

    def path(t):
        return jnp.sum(amplitudes * jnp.sin(jnp.arange(1, 4) * 1.3 * t + phases), axis=1)

    return path(t), jax.jacfwd(path)(t), jax.jacfwd(jax.jacfwd(path))(t)


states = jax.jit(jax.vmap(motion, (None, None, 0)))
torques = jax.jit(jax.vmap(plant.inverse_dynamics))
t, logs = np.arange(0, 6, 0.008), []
for _ in range(5):
    q, qd, qdd = states(random.uniform(0.1, 0.5, (3, 3)), random.uniform(0, 6, (3, 3)), t)
    logs.append((q, torques(q, qd, qdd)))
q, tau = map(np.concatenate, zip(*logs, strict=True))
log = from_arrays(
    {
        "t": np.tile(t, 5),
        "q": q + 1e-4 * random.normal(size=q.shape),
        "tau": tau + 0.2 * random.normal(size=tau.shape),
        "trajectory": np.repeat(np.arange(5), len(t)),
    }
)
smoothed = smooth(log)
print(f"filtered at {smoothed.cutoff:.1f} Hz; noise of torques {np.round(smoothed.noise_tau, 2)} N m")
data = smoothed.data
train, validation, test = (select(data, which) for which in ([0, 1, 2], [3], [4]))

# %%
# Identification
# --------------
# The first fit gives the velocity scale of dry friction. The second gives inertias, armature and friction, with joints
# weighted by their noise and physically consistent links.

laws = ("viscous", "coulomb", "offset")
scales = fit_friction(guess, train, laws).shape["velocity_scale"]
model = make_rigid_tree(guess, friction=laws, velocity_scale=tuple(scales.tolist()))
known = model.init(jax.random.key(0))._replace(viscous=jnp.full(3, 0.1), coulomb=jnp.full(3, 0.1))
identified = identify(model, known, train)
arm = parameters_of(identified.theta, known)
print(f"dry friction {np.round(arm.coulomb, 2)} N m, resolved to {np.round(scales, 3)} rad/s")
print(f"{len(identified.base.words)} base parameters, for example {identified.base.words[2]}")
assert np.abs(arm.coulomb - np.array([0.8, 1.0, 0.4])).max() < 0.1

# %%
# Uncertainty
# -----------
# The fit gives a standard deviation for the torque of any state, which is calibrated on held-out motions.

estimate = uncertainty.estimate(model, arm, train, validation, ridge=0.0, unit=identified.fit.noise, negligible=1e-12)
bands = estimate.uncertainty
std = predictive(model, arm, bands.factor, bands.noise, bands.inflation)
inverse = dln_jax.dynamics(model.energies(arm)).inverse_dynamics
predicted, band = (np.asarray(jax.jit(jax.vmap(f))(test.q, test.qd, test.qdd)) for f in (inverse, std))
covered = np.mean(np.abs(predicted - test.tau) < 1.96 * band)
print(f"{covered:.1%} of the torques of an unseen motion are within the 95 % band")
assert covered > 0.9

# %%
# C
# -
# We export both functions, for a loop at 1 kHz.

state = test.q[0], test.qd[0], test.qdd[0]
folder = Path(tempfile.mkdtemp()) / "arm"
dln_jax.export_c({"inverse_dynamics": (inverse, state), "torque_std": (std, state)}, folder)
in_c = dln_jax.load_c(folder)
assert np.abs(in_c.inverse_dynamics(*state) - predicted[0]).max() < 1e-10
assert np.abs(in_c.torque_std(*state) - band[0]).max() < 1e-10

# %%
# The first figure shows the arm on its unseen motion. The colour of the path is the torque that the model predicts for
# the second joint.

REACH = np.array([0.3, 0.0, 0.0])  # from the third joint to the tip, m


def joints(q):
    rotations, positions = world_frames(true, q)
    return jnp.stack([jnp.zeros(3), *positions, positions[-1] + rotations[-1] @ REACH])


places = np.asarray(jax.jit(jax.vmap(joints))(test.q))
figure, axes = plt.subplots(figsize=(6.5, 5), subplot_kw={"projection": "3d"}, layout="constrained")
path = axes.scatter(*places[:, -1].T, c=predicted[:, 1], cmap="plasma", s=8, depthshade=False)
for index, alpha in ((0, 0.2), (250, 0.4), (500, 1.0)):
    look = {"color": "#3b4252", "linewidth": 6, "markersize": 9, "solid_capstyle": "round", "alpha": alpha}
    axes.plot(*places[index].T, "o-", **look)
figure.colorbar(path, label="torque of joint 2, N m", shrink=0.6)
axes.locator_params(nbins=4)
axes.set(aspect="equal", xlabel="x, m", ylabel="y, m", zlabel="z, m")

# %%
# The second figure shows its torques with 95 % bands.

figure, axes = plt.subplots(3, 1, figsize=(7, 6), sharex=True, layout="constrained")
style.prepare(*axes)
for joint, axis in enumerate(axes):
    axis.plot(test.t, test.tau[:, joint], ".", markersize=2, color="0.6", label="measured")
    axis.plot(test.t, predicted[:, joint], color=style.BLUE, label="identified")
    low, high = (predicted[:, joint] + sign * 1.96 * band[:, joint] for sign in (-1, 1))
    axis.fill_between(test.t, low, high, color=style.BLUE, alpha=0.25, label="95 %")
    axis.set_ylabel(f"torque {joint + 1}, N m")
style.legend(axes[0], ncols=3, loc="upper right")
axes[-1].set_xlabel("t, s")
