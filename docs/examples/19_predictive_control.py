"""
Predictive control on a short rail
==================================

A cart swings a pole up on a rail of one metre, holds it, and brings it up again after blows. Far from the goal, plans
of the next 1.2 seconds are improved in every sample, within the limits of the force and the ends of the rail; near it,
a regulator acts.

.. figure:: /predictive-control.gif
   :alt: A cart-pole swings up between the ends of its rail, is hit twice and recovers; its plan is drawn ahead of it

   The film that this example writes. Pale poles and the dashed line are the plan that acts.
"""

import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dln_jax
from dln_jax.control.recovery import recovery_by_plans
from dln_jax.control.regulators import lqr, regulated, value
from dln_jax.control.state_space import field_of, integrated, linearise
from dln_jax.control.trajectories import TrajectoryProblem, first_plan
from dln_jax.figures import style
from dln_jax.figures.closed_loops import cart_pole_drawing, write_closed_loop_gif
from dln_jax.scenes.pendulums import cart_pole

jax.config.update("jax_enable_x64", True)

SECONDS, FRAMES_PER_SECOND = 6.5, 25.0  # s, 1/s
DT, STEPS = 0.02, 60  # s; 1.2 s ahead
LIMIT, RAIL, LENGTH = 6.0, 0.5, 0.4  # N, m, m
BLOWS = {2.5: 0.02, 4.0: -0.35}  # N s, by the time in s

# %%
# The plant and the plan's problem
# --------------------------------
# States are the positions of cart and pole, the latter's angle from upright, and their rates. Limits of the states may
# be exceeded at a price, so that there is a plan in every state; plans stay 2 cm away from the ends of the rail.

scene = cart_pole(cart_mass=0.6, pole_mass=0.15, length=LENGTH)
plant, B = dln_jax.dynamics(scene.closed_form), np.array(scene.needs.actuation)
field = field_of(plant, B)
wall = np.array([RAIL - 0.02, np.inf, np.inf, np.inf])


def away(x):
    return x[0] ** 2 + 2 * (1 - jnp.cos(x[1])) + 0.1 * x[2] ** 2 + 0.01 * x[3] ** 2


problem = TrajectoryProblem(
    integrated(field, DT),
    lambda x, u: DT * (away(x) + 1e-3 * u @ u),
    lambda x: 20 * away(x),
    -LIMIT,
    LIMIT,
    lower_x=-wall,
    upper_x=wall,
)

# %%
# Plans and a regulator
# ---------------------
# Three plans start from different guesses, since a pole can come up on either side. The regulator takes over where it
# asks for no more than the motor has.

goal, hanging, joints = np.zeros(4), np.array([0.0, np.pi, 0.0, 0.0]), scene.needs.joints
at = linearise(field, goal, np.zeros(1))
regulator = lqr(at.A, at.B, Q=np.diag([10, 10, 1, 0.1]), R=[[0.1]])
level = LIMIT**2 / (regulator.K @ np.linalg.solve(regulator.S, regulator.K.T)).item()
guesses = np.array([0.0, 3.0, -3.0])[:, None, None] * np.sin(5 * DT * np.arange(STEPS))[:, None]
controller = recovery_by_plans(
    problem,
    jax.vmap(lambda u: first_plan(problem, hanging, u))(guesses),
    near=regulated(regulator, goal, at.u, joints),
    cost=value(regulator, goal, joints),
    level=level,
    rate=1 / DT,
    every=1,
)

# %%
# The closed loop
# ---------------
# A blow on the pole's bob changes the momenta of cart and pole, and the controller is not told.

act = jax.jit(controller.act)
advance = jax.jit(integrated(field, DT, substeps=4))


@jax.jit
def hit(x, impulse):
    momenta = impulse * jnp.array([1.0, LENGTH * jnp.cos(x[1])])
    return x.at[2:].add(jnp.linalg.solve(plant.mass_matrix(x[:2]), momenta))


x, memory, states, forces, plans, calls = jnp.asarray(hanging), controller.start, [], [], [], []
for number in range(round(SECONDS / DT)):
    x = hit(x, BLOWS.get(round(number * DT, 6), 0.0))
    states.append(x)
    began = time.perf_counter()
    memory, u = jax.block_until_ready(act(memory, jnp.asarray(number * DT), x))
    calls.append(time.perf_counter() - began)
    u = jnp.clip(u, -LIMIT, LIMIT)
    forces.append(u)
    best = int(np.nanargmin(memory.plans.cost))
    plans.append(None if memory.near else np.asarray(memory.plans.x[best]))
    x = advance(x, u)
x, u, t = np.stack(states), np.stack(forces), DT * np.arange(len(states))
planned = np.array([ahead is not None for ahead in plans])
far = np.abs(x[:, 0]).max()
print(f"largest force {np.abs(u).max():.3f} of {LIMIT} N; the cart comes within {1e3 * (RAIL - far):.0f} mm of an end")
print(f"median time of a call that plans, on this machine: {1e3 * np.median(np.array(calls)[planned]):.2f} ms")
assert np.abs(u).max() <= LIMIT and far < RAIL

# %%
# The regulator holds the pole against the first blow without a plan. The second throws the pole down, and it comes up
# again.

up = np.abs(np.sin(x[:, 1] / 2)) < 0.05
if t[-1] > 6:
    first, second = BLOWS
    assert up[(t > first - 0.5) & (t < first)].all() and not planned[(t > first) & (t < second)].any()
    fallen = t[(t > second) & (np.cos(x[:, 1]) < 0)]
    stays = t[np.flatnonzero(~up)[-1]] - second
    print(f"after the second blow the pole hangs for {DT * len(fallen):.2f} s, and stays up after {stays:.2f} s")
    assert len(fallen) and up[-25:].all()

# %%
# The film and what happens over time
# -----------------------------------


def between_walls(axis, q, trail):
    """The library's cart-pole, the ends of its rail, the plan, and blows."""
    base = cart_pole_drawing(LENGTH)(axis, q, trail)
    for side in (-1, 1):
        axis.axvspan(side * RAIL, side * (RAIL + 0.6), color=style.VERMILLION, alpha=0.12, linewidth=0)
        axis.axvline(side * RAIL, color=style.VERMILLION, linewidth=1.5)
    axis.lines[0].set_xdata([-RAIL, RAIL])
    axis.text(RAIL + 0.02, 1.38 * LENGTH, "end of\nthe rail", color=style.VERMILLION, fontsize=7, va="top")
    (path,) = axis.plot([], [], "--", color=style.BLUE, linewidth=1.0, alpha=0.7)
    ghosts = [axis.plot([], [], color=style.BLUE, linewidth=3, alpha=alpha)[0] for alpha in (0.3, 0.22, 0.15)]
    blow = axis.annotate(
        "", (0, 0), (0, 0), arrowprops={"arrowstyle": "-|>", "color": style.VERMILLION, "linewidth": 2.5}
    )
    wide = RAIL + 0.35
    axis.set(xlim=(-wide, wide), ylim=(-1.35 * LENGTH, 1.45 * LENGTH))

    def show(index):
        base(index)
        ahead = plans[index] if planned[index] else np.full((STEPS + 1, 4), np.nan)
        tips = np.stack([ahead[:, 0] + LENGTH * np.sin(ahead[:, 1]), LENGTH * np.cos(ahead[:, 1])], axis=1)
        path.set_data(*tips.T)
        for k, ghost in zip((8, 16, 24), ghosts, strict=True):
            ghost.set_data([ahead[k, 0], tips[k, 0]], [0.0, tips[k, 1]])
        recent = [impulse for moment, impulse in BLOWS.items() if 0 <= t[index] - moment < 0.3]
        blow.set_visible(bool(recent))
        for impulse in recent:
            start = np.searchsorted(t, next(moment for moment, size in BLOWS.items() if size == impulse))
            tip = x[start, 0] + LENGTH * np.sin(x[start, 1]), LENGTH * np.cos(x[start, 1])
            blow.xy = tip
            blow.set_position((tip[0] - np.sign(impulse) * (0.1 + 0.4 * abs(impulse)), tip[1]))

    return show


write_closed_loop_gif(
    Path("predictive-control.gif"),
    between_walls,
    t,
    x[:, :2],
    u[:, 0],
    limits=(-LIMIT, LIMIT),
    unit="N",
    frames_per_second=FRAMES_PER_SECOND,
)

# %%
# Positions and forces with their limits; blows are dotted.

figure, axes = plt.subplots(3, 1, figsize=(7, 5), sharex=True, layout="constrained")
style.prepare(*axes)
rows = (x[:, 0], RAIL, "cart, m"), (x[:, 1] / (2 * np.pi), None, "pole, turns"), (u[:, 0], LIMIT, "force, N")
for axis, (values, limit, label) in zip(axes, rows, strict=True):
    axis.plot(t, values, color=style.BLUE, linewidth=1.2)
    for blow in BLOWS:
        axis.axvline(blow, color="0.4", linestyle=":", linewidth=1)
    for side in (-1, 1) if limit else ():
        axis.axhline(side * limit, color=style.VERMILLION, linewidth=1)
    axis.set_ylabel(label)
axes[-1].set_xlabel("t, s")
