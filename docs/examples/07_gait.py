"""
A gait in a minute
==================

A soft creature with 24 muscles learns to crawl. Training uses gradients through the simulator, including friction and
contact.
"""

import jax
import matplotlib.pyplot as plt
import numpy as np

from dln_jax.figures import style
from dln_jax.figures.soft_bodies import soft_body_drawing
from dln_jax.locomotion.gradient import make_policy, shown_walk
from dln_jax.locomotion.learning import train
from dln_jax.locomotion.task import make_task
from dln_jax.softbody.mesh.shapes import creature_named

jax.config.update("jax_enable_x64", True)

GOAL = 5.0  # body lengths in an episode
STEPS = 60_000  # environment steps, at most

# %%
# The task
# --------
# The creature has to go as far along x as it can within 400 steps, without a fall.
# `make_task(creature, scene=..., dt=...)` takes a scene of your own: another material, contacts, pressure or tendons.

task = make_task(creature_named("crawler"))
print(f"{len(task.creature.mesh.vertices)} vertices, {task.muscle_count} muscles, body length {task.length:.2f} m")

# %%
# Learning
# --------
# The policy is a network with one hidden layer. It observes the body and a clock, and commands the actuation of the
# muscles, which changes by at most 0.3 per step.

records = []
(trained,) = train(
    task,
    seeds=[0],
    steps=STEPS,
    until=GOAL,
    report=lambda seed, record: records.append(record),
)
for record in records[:: max(1, len(records) // 5)]:
    print(f"{record.steps:6d} environment steps, {record.seconds:4.0f} s: {record.distance:5.2f} body lengths")
assert trained.distance > 1.0

# %%
# The gait
# --------
# The first figure shows the creature in the middle of its walk; contracted muscles are red.

seen = shown_walk(task, make_policy(task), trained.parameters, task.episode)
assert seen.converged.all()
moment = int(np.asarray(seen.actuation).std(axis=1).argmax())
muscles, lengths = task.creature.muscles, seen.actuation[moment : moment + 1]
frame, draw = soft_body_drawing(
    task.creature.mesh, np.asarray(seen.x[moment : moment + 1]), muscles=muscles, actuation=lengths
)
draw(0)

# %%
# The second figure shows its mean position, and the lengths of all muscles over time.

figure, (above, below) = plt.subplots(2, 1, figsize=(7, 5), sharex=True, layout="constrained")
style.prepare(above)
above.plot(seen.x[:, :, 0].mean(axis=1) / task.length, color=style.BLUE)
above.set(ylabel="mean x, body lengths")
below.imshow(np.asarray(seen.actuation).T, aspect="auto", cmap="magma")
below.set(xlabel="step", ylabel="muscle")
