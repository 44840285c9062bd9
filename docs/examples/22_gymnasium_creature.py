"""
A creature for other learners
=============================

A soft crawler as an environment of Gymnasium, for libraries of reinforcement learning such as Stable-Baselines3. Its
steps and rewards are those of `train_locomotion`; a user's own creature, material or contact enters by `make_task`.
"""

import gymnasium
import jax
import matplotlib.pyplot as plt
import numpy as np
from gymnasium.utils.env_checker import check_env

from dln_jax.figures import style
from dln_jax.locomotion.task import FALLEN, advance, beginning, change_of, make_task, observe
from dln_jax.softbody.mesh.shapes import crawler

STEPS = 120

task = make_task(crawler())
begin = jax.jit(lambda key: beginning(task, key))
step = jax.jit(lambda place, action: advance(task, place, change_of(place.actuation, action)))
seen_from = jax.jit(lambda place: observe(task, place))

# %%
# The environment
# ---------------
# Actions in [-1, 1] are commands: the actuation of a muscle approaches its command by at most 0.3 a step. An episode
# ends with a fall, or with a step of the simulator that did not converge; `info["converged"]` tells which.


class CrawlerEnvironment(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (task.observation_size,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (task.muscle_count,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = begin(jax.random.key(int(self.np_random.integers(2**31))))
        return np.asarray(seen_from(self.place), np.float32), {}

    def step(self, action):
        self.place, after = step(self.place, np.asarray(action, self.place.state.x.dtype))
        converged = bool(after.converged)
        over = not converged or float(after.tilt) > FALLEN
        info = {"x": np.asarray(after.x), "converged": converged}
        observation = np.asarray(seen_from(self.place), np.float32)
        return observation, float(after.reward), over, int(self.place.steps) >= task.episode, info


environment = CrawlerEnvironment()
check_env(environment, skip_render_check=True)

# %%
# A walk by random commands
# -------------------------

environment.reset(seed=0)
random, walk, held = np.random.default_rng(0), [], 10
for number in range(STEPS):
    if number % held == 0:
        command = random.uniform(-1, 1, task.muscle_count).astype(np.float32)
    walk.append(environment.step(command))
assert all(one[4]["converged"] for one in walk)
x = np.array([one[4]["x"] for one in walk])
print(f"{len(walk)} steps, return {sum(one[1] for one in walk):.3f}")

figure, axes = plt.subplots(figsize=(7, 3), layout="constrained")
style.prepare(axes)
for number, colour in ((0, style.BLUE), (STEPS // 2, style.GREEN), (STEPS - 1, style.VERMILLION)):
    axes.triplot(*x[number].T, task.creature.mesh.elements, linewidth=0.6, color=colour)
axes.set(xlabel="x, m", ylabel="y, m", aspect="equal", title="the first step, half way, and the last step")
