"""
A plant for other learners
==========================

A cart-pole with its encoders, delay and limits as an environment of Gymnasium, for libraries of reinforcement learning
such as Stable-Baselines3. It is the closed loop of `simulate`: a controller learned there meets the same sensors here.
"""

import gymnasium
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from gymnasium.utils.env_checker import check_env

import dln_jax
from dln_jax.control.closed_loop import Controller, Hardware, delivered, measured, simulate
from dln_jax.control.state_space import field_of, integrated
from dln_jax.figures import style
from dln_jax.scenes.pendulums import cart_pole

jax.config.update("jax_enable_x64", True)

RATE, SAMPLES = 50.0, 250  # Hz, length of an episode

scene = cart_pole()
field = field_of(dln_jax.dynamics(scene.closed_form), np.array(scene.needs.actuation))
hardware = Hardware(-10.0, 10.0, encoder_step=1e-3, delay=1)
advance = integrated(field, 1 / RATE)

# %%
# Pure functions
# --------------
# A place is the state, the controls on their way and the number of the sample.


@jax.jit
def begin(key):
    x = jnp.array([0.0, jnp.pi, 0.0, 0.0]) + 0.05 * jax.random.normal(key, (4,))
    return (x, jnp.zeros((hardware.delay, 1)), jnp.asarray(0)), observation(x, key)


@jax.jit
def sample(place, action, key):
    x, queue, number = place
    of_control, of_encoder = jax.random.split(jax.random.fold_in(key, number))
    u, queue = delivered(hardware, queue, 10.0 * action, of_control)
    cost = (x[0] ** 2 + 1 - jnp.cos(x[1]) + 1e-3 * u @ u) / RATE
    after = advance(x, u)
    return (after, queue, number + 1), observation(after, of_encoder), cost


def observation(x, key):
    y = measured(hardware, x, key)
    return jnp.array([y[0], jnp.cos(y[1]), jnp.sin(y[1]), y[2], y[3]])


# %%
# The environment
# ---------------
# Actions in [-1, 1] span the limits. A state that is not finite ends the episode with a cost above that of any other.


class CartPole(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (5,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.key = jax.random.key(int(self.np_random.integers(2**32)))
        self.place, seen = begin(self.key)
        self.seen = np.asarray(seen, np.float32)
        return self.seen, {"x": np.asarray(self.place[0])}

    def step(self, action):
        self.place, seen, cost = sample(self.place, np.asarray(action, float), self.key)
        failed = not (np.isfinite(seen).all() and np.isfinite(cost))
        self.seen = self.seen if failed else np.asarray(seen, np.float32)
        over = int(self.place[2]) >= SAMPLES and not failed
        return self.seen, -1e3 if failed else -float(cost), failed, over, {"x": np.asarray(self.place[0])}


environment = CartPole()
check_env(environment, skip_render_check=True)
gymnasium.register("dln_jax/CartPole-v0", CartPole)  # for gymnasium.make, and the libraries that call it

# %%
# An episode
# ----------
# Random actions, and the same ones in `simulate`.

first, info = environment.reset(seed=0)
actions = np.random.default_rng(0).uniform(-1, 1, (SAMPLES, 1)).astype(np.float32)
steps = [environment.step(action) for action in actions]
x = np.array([info["x"], *(step[4]["x"] for step in steps)])
law = Controller(jnp.asarray(0), lambda k, t, y: (k + 1, 10.0 * jnp.asarray(actions, float)[k]))
run = simulate(field, law, info["x"], seconds=SAMPLES / RATE, rate=RATE, controls=1, hardware=hardware)
np.testing.assert_allclose(x, run.x, rtol=1e-9, atol=1e-9)
assert steps[-1][3] and not any(step[2] or step[3] for step in steps[:-1])
print(f"{SAMPLES} samples, return {sum(step[1] for step in steps):.3f}")

figure, axes = plt.subplots(2, 1, figsize=(7, 4), sharex=True, layout="constrained")
style.prepare(*axes)
axes[0].plot(run.t, x[:, 0], color=style.BLUE, label="cart, m")
axes[0].plot(run.t, x[:, 1] - np.pi, color=style.VERMILLION, label="pole from hanging, rad")
axes[0].legend(fontsize=8, frameon=False)
axes[1].plot(run.t[:-1], [step[1] for step in steps], color=style.GREEN)
axes[1].set(xlabel="t, s", ylabel="reward")
