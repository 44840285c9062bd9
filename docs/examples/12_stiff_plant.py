"""
A plan through a stiff plant
============================

A driven cart pulls a second one, which carries a free pole, by a spring that is nearly rigid. Its motion is slow, but
an explicit integrator has to follow the spring: here 200 steps or more where 40 are planned. Multiple shooting plans
through an implicit one, from a guess that is no motion at all.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dln_jax
from dln_jax import control
from dln_jax.mechanics.integrators import CLASSICAL, RADAU_3
from dln_jax.scenes import flexible_cart_pole

jax.config.update("jax_enable_x64", True)

STEPS = 40
DT, LIMIT = 0.04, 15.0  # s and N
STIFFNESS = 2e4  # N/m

# %%
# The plant
# ---------
# The fastest motion is that of the spring; a classical Runge-Kutta step is stable up to 2.8 of its radians.

scene = flexible_cart_pole(stiffness=STIFFNESS)
plant, B = dln_jax.dynamics(scene.energies), np.array(scene.needs.actuation)
field, goal = jax.jit(control.field_of(plant, B)), np.zeros(6)
start = np.array([0.0, 0.0, np.pi, 0.0, 0.0, 0.0])
modes = np.linalg.eigvals(control.linearise(field, start, np.zeros(1)).A)
print(f"the spring swings at {abs(modes).max():.0f} rad/s, the pole at {abs(modes[abs(modes) < 20]).max():.1f} rad/s")
assert abs(modes).max() * DT > 2.8

# %%
# The plan
# --------
# Swing up within 1.6 s. The guess is a straight line from hanging to upright with no force at all; its defects are what
# the steps miss of it. Of the costs, angles are off the goal as 2 (1 - cos).


def off(x):
    return x[0] ** 2 + 2 * (1 - jnp.cos(x[2])) + 0.02 * (x[3] ** 2 + (0.18 * x[5]) ** 2)


problem = control.TrajectoryProblem(
    step=control.integrated(field, DT, method=RADAU_3),
    cost=lambda x, u: DT * (off(x) + 1e-3 * u @ u),
    final_cost=lambda x: 50 * off(x),
    lower=-LIMIT,
    upper=LIMIT,
)
guess, still = np.linspace(start, goal, STEPS + 1), np.zeros((STEPS, 1))
found = jax.jit(lambda: control.shoot(problem, start, guess, still))()
plan = found.plan
print(f"{found.iterations} iterations, largest defect {found.defect:.1e}, cost {plan.cost:.3f}")
assert found.converged

# %%
# The truth
# ---------
# By 2000 classical steps a second, with the plan's own feedback u + K (x - plan) at its samples, within the limits.
# Classical steps as long as the plan's explode.

many = jax.jit(control.integrated(field, DT, method=CLASSICAL, substeps=int(2000 * DT)))
few = jax.jit(control.integrated(field, DT, method=CLASSICAL))
true, forces, exploded = [jnp.asarray(start)], [], jnp.asarray(start)
for x, u, K in zip(plan.x, plan.u, plan.K, strict=False):
    forces.append(jnp.clip(u + K @ (true[-1] - x), -LIMIT, LIMIT))
    true.append(many(true[-1], forces[-1]))
    exploded = few(exploded, u)
apart = np.abs(np.stack(true) - plan.x)[:, [0, 2]].max()
print(f"cart and pole stay within {apart:.3f} of the plan; explicit steps of {DT} s explode")
assert apart < 0.2 and not np.abs(exploded).max() < 1e3

figure, (above, below) = plt.subplots(2, 1, figsize=(7, 4.5), sharex=True, layout="constrained")
t = DT * np.arange(STEPS + 1)
for index, name, colour in ((0, "cart, m", "tab:blue"), (2, "pole, rad", "tab:orange")):
    above.plot(t, np.stack(true)[:, index], color=colour, label=name)
    above.plot(t, plan.x[:, index], "o", color=colour, markersize=3)
    above.plot(t, guess[:, index], ":", color=colour)
above.legend(title="line: truth, dots: plan,\ndotted: guess")
below.step(t[:-1], np.stack(forces)[:, 0], where="post", color="tab:blue")
below.plot(t[:-1], plan.u[:, 0], "o", color="tab:blue", markersize=3)
for limit in (-LIMIT, LIMIT):
    below.axhline(limit, color="tab:red")
below.set(xlabel="t, s", ylabel="force, N")
