"""
A gait in a minute
==================

A soft creature with 24 muscles learns to crawl. Gradients go back through the simulator, friction and contact included;
two thousand environment steps are enough for a body length, and most of the time is compilation.
"""

import jax
import matplotlib.pyplot as plt
import numpy as np

from dln_jax.locomotion import Goal, creature_named, make_task, shown_walk, train

jax.config.update("jax_enable_x64", True)

GOAL = 1.0  # body lengths in an episode
STEPS = 6_000  # environment steps, at most

# %%
# The task
# --------
# Go as far along x as you can within 80 steps, and do not fall.

task = make_task(creature_named("crawler"))
print(f"{len(task.creature.mesh.vertices)} vertices, {task.muscle_count} muscles, body length {task.length:.2f} m")

# %%
# Learning
# --------
# A policy of one hidden layer, from what it sees of its body to the actuation of its muscles.

records = []
trained = train(
    task,
    seeds=[0],
    goal=Goal(steps=STEPS, distance=GOAL),
    report=lambda seed, record: records.append(record),
)
for record in records[:: max(1, len(records) // 5)]:
    print(f"{record.steps:6d} environment steps, {record.seconds:4.0f} s: {record.distance:5.2f} body lengths")
assert trained.best.distance > min(GOAL, 0.2)

# %%
# The gait
# --------
# Where its middle is, and how much its first muscles pull.

seen = shown_walk(task, trained.policy, trained.best.parameters, task.episode)
assert seen.converged.all()
figure, (above, below) = plt.subplots(2, 1, figsize=(7, 5), sharex=True)
above.plot(seen.x[:, :, 0].mean(axis=1) / task.length)
above.set(ylabel="mean x, body lengths")
below.imshow(np.asarray(seen.actuation).T, aspect="auto", cmap="magma")
below.set(xlabel="step", ylabel="muscle")
figure.tight_layout()
