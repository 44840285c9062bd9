"""
Quiet torques from coarse encoders
==================================

Encoders of 512 steps a turn are the only sensors of a rotary pendulum. Differences of their readings are noisy rates,
and a regulator turns them into a torque that jumps between its limits. Filters that know the model give rates that are
fifty times closer to the truth, and the same regulator holds the pole with a twentieth of the torque.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dln_jax
from dln_jax.control.closed_loop import Hardware, simulate
from dln_jax.control.estimate.kalman import belief, filtered, mechanical
from dln_jax.control.observers import with_differences, with_estimate
from dln_jax.control.regulators import lqr, regulated
from dln_jax.control.state_space import field_of, linearise
from dln_jax.figures import style
from dln_jax.scenes.pendulums import rotary_pendulum

jax.config.update("jax_enable_x64", True)

SECONDS = 4.0  # s
RATE, LIMIT, STEP = 500.0, 0.05, 2 * np.pi / 512  # Hz, N m, rad

# %%
# The plant and its regulator
# ---------------------------
# Torques are limited, noisy and a sample late.

scene = rotary_pendulum(friction=1e-5)
plant, B, joints = dln_jax.dynamics(scene.closed_form), np.array(scene.needs.actuation), scene.needs.joints
field, goal = field_of(plant, B), np.zeros(4)
at = linearise(field, goal, np.zeros(1))
regulator = lqr(at.A, at.B, Q=np.diag([1, 1, 0.01, 0.01]), R=[[50.0]])
law = regulated(regulator, goal, at.u, joints)
hardware = Hardware(-LIMIT, LIMIT, encoder_step=STEP, control_noise=2.5e-4, delay=1, sees_rates=False)

# %%
# Three ways to the rates
# -----------------------
# The process is the model with a random torque at the motor, and measurements with the variance of an encoder's step.

process = mechanical(plant, B, rate=RATE, band=[5e-4, 1e-5], encoder_step=STEP)
prior = belief(goal, 0.1)
filters = {"extended": process, "unscented": process._replace(unscented=True)}
controllers = {"differences": with_differences(law, 2, rate=RATE, cutoff=50.0)}
for name, filter in filters.items():
    controllers[name] = with_estimate(law, filter, prior, rate=RATE, controls=1, lower=-LIMIT, upper=LIMIT, delay=1)

# %%
# The torque at the goal
# ----------------------
# The pole starts 3 degrees from upright. Reversals are changes of the torque's sign.


def held(controller):
    start = [0.1, 0.05, 0.0, 0.0]
    return simulate(
        field, controller, start, seconds=SECONDS, rate=RATE, controls=1, hardware=hardware, key=jax.random.key(0)
    )


runs = {name: jax.jit(lambda controller=controller: held(controller))() for name, controller in controllers.items()}
last, chatter = round(SECONDS * RATE / 2), {}
for name, run in runs.items():
    u = np.asarray(run.u[-last:, 0])
    rms, reversals = np.sqrt(np.mean(u**2)), np.sum(u[1:] * u[:-1] < 0) / (last / RATE)
    chatter[name] = rms, reversals
    print(f"{name}: torque at the goal {1e3 * rms:.2f} mN m rms, {reversals:.0f} reversals a second")
    assert np.abs(run.x[-last:, 1]).max() < 0.15

# %%
# The rates
# ---------
# All of them along the motion that differences drive.

log = runs["differences"]
share = -np.expm1(-2 * np.pi * 50.0 / RATE)
raw = RATE * jnp.diff(log.y, axis=0, prepend=log.y[:1])
low_pass = lambda qd, row: (qd + share * (row - qd),) * 2  # noqa: E731
rates = {"differences": jax.lax.scan(low_pass, jnp.zeros(2), raw)[1]}
for name, filter in filters.items():
    rates[name] = jax.jit(lambda filter=filter: filtered(filter, prior, log.y, log.u)[0][:, 2:])()
truth, errors = np.asarray(log.x[:-1, 2:]), {}
settled = slice(round(0.2 * RATE), None)
for name, qd in rates.items():
    errors[name] = np.sqrt(np.mean((np.asarray(qd) - truth)[settled] ** 2, axis=0))
    print(f"{name}: rms error of the rates {errors[name][0]:.3f} rad/s (arm), {errors[name][1]:.3f} rad/s (pole)")
assert all((errors[name] < 0.5 * errors["differences"]).all() for name in filters)
assert all(chatter[name][0] < 0.5 * chatter["differences"][0] for name in filters)

# %%
# Torques of the last half second, and how much they chatter.

colours = dict(zip(rates, (style.VERMILLION, style.BLUE, style.GREEN), strict=True))
figure, axes = plt.subplots(1, 3, figsize=(9, 3), width_ratios=(2.2, 1, 1), layout="constrained")
style.prepare(*axes)
t = np.asarray(log.t[:-1])
shown = t > t[-1] - 0.5
for name, run in runs.items():
    axes[0].plot(
        t[shown], 1e3 * run.u[shown, 0], color=colours[name], linewidth=1.2, label=name, drawstyle="steps-post"
    )
for limit in (-1e3 * LIMIT, 1e3 * LIMIT):
    axes[0].axhline(limit, color="0.4", linewidth=1, linestyle=":")
axes[0].set(xlabel="t, s", ylabel="torque, mN m")
axes[0].legend(fontsize=8, ncols=3, loc="lower left", bbox_to_anchor=(0, 1), frameon=False)
for axis, row, scale, label in ((axes[1], 0, 1e3, "torque, mN m rms"), (axes[2], 1, 1.0, "reversals a second")):
    values = [scale * chatter[name][row] for name in runs]
    bars = axis.bar(range(len(runs)), values, color=[colours[name] for name in runs])
    axis.bar_label(bars, fmt="%.3g", fontsize=8)
    axis.set_xticks(range(len(runs)), runs, rotation=25, ha="right")
    axis.set_ylabel(label)
    axis.margins(y=0.12)

# %%
# The pole's rate by differences, and the errors of the filters, which would hide the truth.

figure, axes = plt.subplots(2, 1, figsize=(8, 5), sharex=True, layout="constrained")
style.prepare(*axes)
shown = (t > t[-1] / 4) & (t < t[-1] / 4 + 0.3)
axes[0].plot(t[shown], truth[shown, 1], color="black", linewidth=2.0, label="truth")
axes[0].plot(t[shown], np.asarray(rates["differences"])[shown, 1], color=colours["differences"], label="differences")
axes[0].set_ylabel("rate of the pole, rad/s")
for name, line in zip(filters, ("-", "--"), strict=True):
    off = 1e3 * (np.asarray(rates[name]) - truth)[shown, 1]
    axes[1].plot(t[shown], off, line, color=colours[name], label=name)
axes[1].set(xlabel="t, s", ylabel="error, mrad/s")
for axis in axes:
    axis.legend(fontsize=8, ncols=3, loc="lower left", bbox_to_anchor=(0, 1), frameon=False)
