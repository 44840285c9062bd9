"""
A plan through a stiff plant
============================

A driven cart pulls a second cart, which carries a free pole, by a nearly rigid spring. The motion is slow, but an
explicit integrator has to follow the spring: it needs 200 steps or more where the plan has 40. Multiple shooting plans
the motion through an implicit integrator, from a guess that does not satisfy the dynamics.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dln_jax
from dln_jax.control.shooting import shoot
from dln_jax.control.state_space import field_of, integrated, linearise
from dln_jax.control.trajectories import TrajectoryProblem
from dln_jax.figures import style
from dln_jax.mechanics.integrators import radau3
from dln_jax.scenes.pendulums import flexible_cart_pole

jax.config.update("jax_enable_x64", True)

STEPS = 40
DT, LIMIT = 0.04, 15.0  # s and N
STIFFNESS = 2e4  # N/m

# %%
# The plant
# ---------
# The spring has the fastest motion. A classical Runge-Kutta step is stable if the spring turns by at most 2.8 rad in
# it.

scene = flexible_cart_pole(stiffness=STIFFNESS)
plant, B = dln_jax.dynamics(scene.closed_form), np.array(scene.needs.actuation)
field, goal = jax.jit(field_of(plant, B)), np.zeros(6)
start = np.array([0.0, 0.0, np.pi, 0.0, 0.0, 0.0])
modes = np.linalg.eigvals(linearise(field, start, np.zeros(1)).A)
print(f"the spring swings at {abs(modes).max():.0f} rad/s, the pole at {abs(modes[abs(modes) < 20]).max():.1f} rad/s")
assert abs(modes).max() * DT > 2.8

# %%
# The plan
# --------
# The pole has to swing up within 1.6 s. The guess is a straight line from hanging to upright without a force. Its
# defects are the differences between its states and the steps from the states before. The cost of the angle is 2 (1 -
# cos).


def off(x):
    return x[0] ** 2 + 2 * (1 - jnp.cos(x[2])) + 0.02 * (x[3] ** 2 + (0.18 * x[5]) ** 2)


problem = TrajectoryProblem(
    step=integrated(field, DT, method=radau3),
    cost=lambda x, u: DT * (off(x) + 1e-3 * u @ u),
    final_cost=lambda x: 50 * off(x),
    lower=-LIMIT,
    upper=LIMIT,
)
guess, still = np.linspace(start, goal, STEPS + 1), np.zeros((STEPS, 1))
solution = jax.jit(lambda: shoot(problem, start, guess, still))()
plan = jax.tree.map(np.asarray, solution.plan)
print(f"{solution.iterations} iterations, largest defect {solution.defect:.1e}, cost {plan.cost:.3f}")
assert solution.converged

# %%
# The truth
# ---------
# We simulate the plant with 2000 classical steps per second, and with the plan's own feedback u + K (x - plan) at its
# samples, within the limits. Classical steps as long as the plan's diverge.

many = jax.jit(integrated(field, DT, substeps=int(2000 * DT)))
few = jax.jit(integrated(field, DT))
true, forces, diverged = [start], [], start
for x, u, K in zip(plan.x, plan.u, plan.K, strict=False):
    forces.append(np.clip(u + K @ (true[-1] - x), -LIMIT, LIMIT))
    true.append(np.asarray(many(true[-1], forces[-1])))
    diverged = few(diverged, u)
apart = np.abs(np.stack(true) - plan.x)[:, [0, 2]].max()
print(f"cart and pole stay within {apart:.3f} of the plan; explicit steps of {DT} s diverge")
assert apart < 0.2 and not np.abs(diverged).max() < 1e3

# %%
# The first figure shows the true motion from top to bottom, with the driven cart, the spring, the second cart and its
# pole.

motion = np.stack(true)
figure, axes = plt.subplots(figsize=(6, 6), layout="constrained")
for row, index in enumerate((0, 4, 7, 9, 12, 40)):
    x, y, angle = motion[index, 0], -0.5 * row, motion[index, 2]
    carried, zigzag = x + 0.45 + motion[index, 1], np.tile([0, 0.04, 0, -0.04], 6)
    axes.plot([-1.2, 1.2], [y - 0.09] * 2, color="0.75", linewidth=1.5, zorder=0)
    axes.plot(np.linspace(x + 0.1, carried - 0.1, 24), y + zigzag, color=style.ORANGE, linewidth=1.5)
    for cart, colour in ((x, "#3b4252"), (carried, style.BLUE)):
        axes.add_patch(plt.Rectangle((cart - 0.1, y - 0.06), 0.2, 0.12, color=colour))
        axes.plot([cart - 0.06, cart + 0.06], [y - 0.07] * 2, "o", color="0.4", markersize=6)
    axes.plot([carried, carried + 0.178 * np.sin(angle)], [y, y + 0.178 * np.cos(angle)], color="#2e6fa7", linewidth=4)
    axes.plot(carried + 0.178 * np.sin(angle), y + 0.178 * np.cos(angle), "o", color=style.VERMILLION, markersize=10)
    axes.text(-1.2, y, f"{DT * index:.2f} s", va="center", ha="right", fontsize=style.TEXT)
axes.set(aspect="equal", xlim=(-1.2, 1.2))
axes.set_axis_off()

# %%
# The second figure shows plan, truth and guess over time.

figure, (above, below) = plt.subplots(2, 1, figsize=(7, 4.5), sharex=True, layout="constrained")
style.prepare(above, below)
t = DT * np.arange(STEPS + 1)
for index, name, colour in ((0, "cart, m", style.BLUE), (2, "pole, rad", style.ORANGE)):
    above.plot(t, motion[:, index], color=colour, label=name)
    above.plot(t, plan.x[:, index], "o", color=colour, markersize=3)
    above.plot(t, guess[:, index], ":", color=colour)
style.legend(above, title="line: truth, dots: plan,\ndotted: guess")
below.step(t[:-1], np.stack(forces)[:, 0], where="post", color=style.BLUE)
below.plot(t[:-1], plan.u[:, 0], "o", color=style.BLUE, markersize=3)
for limit in (-LIMIT, LIMIT):
    below.axhline(limit, color=style.VERMILLION)
below.set(xlabel="t, s", ylabel="force, N")
