"""
Fine-tune a loaded run
======================

Yesterday you trained a model of an arm, and overnight the arm was changed. Load the run and start from its parameters:
a few samples of the new arm are enough.
"""

import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax

import dln_jax
from dln_jax import dynamics
from dln_jax.commands import train_delan
from dln_jax.figures import style
from dln_jax.mechanics.integrators import rk4, rollout, second_order
from dln_jax.runs.arguments import arguments_of
from dln_jax.scenes.datasets.generators import default_data
from dln_jax.scenes.pendulums import LINK_LENGTH, two_link_arm

jax.config.update("jax_enable_x64", True)

ITERATIONS, FINE_STEPS = 20, 400

# %%
# Yesterday
# ---------
# The command line makes a run, whose folder has everything needed to rebuild the model.

folder = Path(tempfile.mkdtemp()) / "run"
options = arguments_of(train_delan.Arguments, steps=ITERATIONS, out=folder, figures=False, uncertainty=False)
train_delan.main(options)
run = dln_jax.load(folder)
count = sum(leaf.size for leaf in jax.tree.leaves(run.parameters))
print(f"{run.description['name']} with {count} parameters")

# %%
# Today
# -----
# Heavier links increase all torques by a fifth, and a flywheel at the shoulder adds inertia. We record three letters of
# the changed arm, and one more for a test.

scene = two_link_arm()
letters = default_data(scene)
names = [str(label) for label in letters.label]


def recorded(wanted):
    rows = np.isin(letters.trajectory, [names.index(name) for name in wanted])
    q, qd, qdd, tau = (getattr(letters, key)[rows] for key in ("q", "qd", "qdd", "tau"))
    return q, qd, qdd, 1.2 * tau + np.stack([0.3 * qdd[:, 0], 0 * qdd[:, 0]], axis=1)


train, test = recorded(("a", "b", "c")), recorded(("e",))


@jax.jit
def loss(parameters, data):
    q, qd, qdd, tau = data
    predicted = jax.vmap(dynamics(run.model.energies(parameters)).inverse_dynamics)(q, qd, qdd)
    return jnp.mean(jnp.sum((predicted - tau) ** 2, axis=1))


# %%
# Training goes on
# ----------------
# The model is a pure function of its parameters, so any optimiser works. The training compiles into one program.

optimiser = optax.adam(optax.cosine_decay_schedule(3e-3, FINE_STEPS))


@jax.jit
def fine_tune(parameters):
    def update(carry, _):
        parameters, state = carry
        value, gradient = jax.value_and_grad(loss)(parameters, train)
        updates, state = optimiser.update(gradient, state)
        return (optax.apply_updates(parameters, updates), state), value

    start = parameters, optimiser.init(parameters)
    (parameters, _), values = jax.lax.scan(update, start, length=FINE_STEPS)
    return parameters, values


parameters, values = fine_tune(run.parameters)
before, after = (float(loss(of, test)) for of in (run.parameters, parameters))
print(f"torque MSE of the new arm's test letter: {before:.2e} before, {after:.2e} after, in (N m)²")
assert after < 0.1 * before

# %%
# Writing, before and after
# -------------------------
# The new arm writes the test letter, with the torques of each model and weak feedback.

plant = dynamics(scene.closed_form)
letter = letters.trajectory == names.index("e")
t, *reference = (np.asarray(array[letter]) for array in (letters.t, letters.q, letters.qd, letters.qdd))


def tips(parameters):
    model = dynamics(run.model.energies(parameters))

    def accelerate(time, q, qd):
        wanted = [jnp.stack([jnp.interp(time, t, column) for column in array.T]) for array in reference]
        tau = model.inverse_dynamics(*wanted) + 5.0 * (wanted[0] - q) + 1.0 * (wanted[1] - qd)
        mass = 1.2 * plant.mass_matrix(q) + jnp.diag(jnp.array([0.3, 0.0]))
        return jnp.linalg.solve(mass, tau - 1.2 * plant.inverse_dynamics(q, qd, 0 * q))

    start = jnp.asarray(reference[0][0]), jnp.asarray(reference[1][0])
    q, _ = rollout(rk4(second_order(accelerate)), start, t)
    return q, jax.vmap(scene.tip)(q)


written, wanted = jax.jit(tips), np.asarray(jax.vmap(scene.tip)(jnp.asarray(reference[0])))
figure, axes = plt.subplots(1, 2, figsize=(8, 3.6), layout="constrained", sharex=True, sharey=True)
worst = []
for axis, title, weights in zip(axes, ("yesterday's model", "fine-tuned"), (run.parameters, parameters), strict=True):
    q, tip = map(np.asarray, written(weights))
    worst.append(np.abs(tip - wanted).max())
    elbow = LINK_LENGTH * np.array([np.cos(q[-1, 0]), np.sin(q[-1, 0])])
    axis.plot(*wanted.T, color="0.85", linewidth=8, solid_capstyle="round")
    axis.plot(*tip.T, color=style.BLUE, linewidth=2)
    links = np.stack([np.zeros(2), elbow, tip[-1]])
    axis.plot(*links.T, "o-", color="#3b4252", linewidth=7, markersize=10, solid_capstyle="round")
    axis.plot(0, 0, "o", color=style.VERMILLION, markersize=28, zorder=0)  # the flywheel
    axis.set(aspect="equal")
    axis.set_axis_off()
    style.title(axis, f"{title}: within {1e3 * worst[-1]:.0f} mm")
assert worst[1] < 0.5 * worst[0]
