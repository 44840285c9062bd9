"""
Fine-tune a loaded run
======================

The arm of yesterday's training was changed overnight. Its parameters are public: load the run, start from them, and a
few samples of the new arm are enough.
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
from dln_jax.cli.commands import train_delan
from dln_jax.scenes import two_link_arm
from dln_jax.scenes.datasets.generators import default_data

jax.config.update("jax_enable_x64", True)

ITERATIONS, FINE_STEPS = 20, 400

# %%
# Yesterday
# ---------
# A run of the command line, whose folder holds everything that is needed to rebuild the model.

folder = Path(tempfile.mkdtemp()) / "run"
train_delan.main(train_delan.Arguments(steps=ITERATIONS, out=folder, figures=False, low_latency=False))
run = dln_jax.load(folder)
count = sum(leaf.size for leaf in jax.tree.leaves(run.parameters))
print(f"{run.description['name']} with {count} parameters")

# %%
# Today
# -----
# Heavier links make all torques greater by a fifth, and a flywheel at the shoulder adds inertia: three letters of the
# changed arm were recorded, and one more for a test.

letters = default_data(two_link_arm())
names = [str(label) for label in letters.label]


def recorded(wanted):
    rows = np.isin(letters.trajectory, [names.index(name) for name in wanted])
    q, qd, qdd, tau = (getattr(letters, key)[rows] for key in ("q", "qd", "qdd", "tau"))
    return q, qd, qdd, 1.2 * tau + np.stack([0.3 * qdd[:, 0], 0 * qdd[:, 0]], axis=1)


train, test = recorded(("a", "b", "c")), recorded(("e",))


def loss(parameters, data):
    q, qd, qdd, tau = data
    predicted = jax.vmap(dynamics(run.model.energies(parameters)).inverse_dynamics)(q, qd, qdd)
    return jnp.mean(jnp.sum((predicted - tau) ** 2, axis=1))


# %%
# Training goes on
# ----------------
# The model is a pure function of its parameters: any optimiser will do. All of it compiles into one program.

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

figure, axes = plt.subplots(figsize=(6, 3))
axes.semilogy(values)
axes.set(xlabel="step", ylabel="torque MSE, (N m)²")
figure.tight_layout()
