"""Swing-ups of plants that share no equation with this library, from 30 s of noisy data each, without a gain by hand.

Three MJCF files of random sizes, an acrobot of Gymnasium with continuous torque, and a rotary pendulum of MuJoCo on a
tilted base. Each function is all that a user has to write. `chain_plants` and `urdf_plants` have more plants.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from dln_jax.control.closed_loop import Hardware
from dln_jax.control.plants.mujoco_plants import mujoco_plant
from dln_jax.control.plants.outside_loops import gymnasium_plant
from dln_jax.control.plants.plant import Plant, layout
from dln_jax.training.swing_ups.any_plant import SECONDS, learn_to_swing_up, try_plant
from dln_jax.types import InputError
from scripts.reports.case import Findings
from scripts.reports.control.chain_plants import CHAIN_PLANTS
from scripts.reports.control.urdf_plants import URDF_PLANTS
from scripts.reports.rows import Row

TURN = 2 * np.pi / 4096
STARTS, TO_REACH = 100, 0.99
DRAWS = (0, 1, 2)
"""Seeds of the sizes."""
SOLID = 'contype="0" conaffinity="0"'


def cart_pole(sizes: int, seed: int) -> Plant:
    """A cart on a rail of 1.2 m with a rod; masses and length by chance."""
    cart, pole, length = np.random.default_rng(sizes).uniform((0.4, 0.08, 0.25), (1.0, 0.2, 0.5))
    text = f"""<mujoco><option timestep="0.002" integrator="RK4"/><worldbody><body>
      <joint name="rail" type="slide" axis="1 0 0" range="-0.6 0.6" limited="true" damping="0.1" frictionloss="0.2"/>
      <geom type="box" size=".05 .04 .03" mass="{cart}" {SOLID}/>
      <body><joint name="hinge" axis="0 1 0" damping="5e-4"/>
      <geom type="capsule" fromto="0 0 0 0 0 -{length}" size=".01" mass="{pole}" {SOLID}/></body>
    </body></worldbody></mujoco>"""
    lab = Hardware(encoder_step=np.array([2.5e-5, TURN]), control_noise=0.05, delay=1)
    return mujoco_plant(text, ["rail"], control=10.0, hardware=lab, seed=seed)


def _two_links(sizes: int, seed: int, driven: str) -> Plant:
    first, second, m1, m2 = np.random.default_rng(sizes).uniform((0.15, 0.2, 0.3, 0.3), (0.25, 0.35, 0.6, 0.6))
    text = f"""<mujoco><option timestep="0.002" integrator="RK4"/><worldbody><body>
      <joint name="shoulder" axis="0 1 0" damping="0.002"/>
      <geom type="capsule" fromto="0 0 0 0 0 -{first}" size=".015" mass="{m1}" {SOLID}/>
      <body pos="0 0 -{first}"><joint name="elbow" axis="0 1 0" damping="0.002"/>
      <geom type="capsule" fromto="0 0 0 0 0 -{second}" size=".015" mass="{m2}" {SOLID}/></body>
    </body></worldbody></mujoco>"""
    lab = Hardware(encoder_step=TURN, control_noise=0.02, delay=1)
    return mujoco_plant(text, [driven], control=5.0, hardware=lab, seed=seed)


def rotary_pendulum(sizes: int, seed: int) -> Plant:
    """A rotary pendulum whose base is tilted by 4 degrees about a random level axis."""
    turn = np.random.default_rng(sizes).uniform(0, 2 * np.pi)
    x, y = np.deg2rad(4.0) * np.array([np.cos(turn), np.sin(turn)])
    text = f"""<mujoco><option timestep="0.002" integrator="RK4"/><worldbody><body euler="{x} {y} 0">
      <joint name="arm" axis="0 0 1" damping="1e-4" frictionloss="1e-3"/>
      <geom type="capsule" fromto="0 0 0 .085 0 0" size=".006" mass=".095" {SOLID}/>
      <body pos=".085 0 0"><joint name="pole" axis="1 0 0" damping="1e-5"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.129" size=".004" mass=".024" {SOLID}/></body>
    </body></worldbody><compiler angle="radian"/></mujoco>"""
    lab = Hardware(encoder_step=TURN, control_noise=2.5e-4, delay=1)
    return mujoco_plant(text, ["arm"], control=0.05, hardware=lab, seed=seed)


def gymnasium_acrobot(sizes: int, seed: int) -> Plant:
    """The acrobot of Gymnasium, 1 m and 1 kg a link, with any torque up to 20 N m, at 200 Hz, with encoders."""
    from gymnasium.envs.classic_control import AcrobotEnv

    class Torque:
        def __getitem__(self, torque: float) -> float:
            return torque

    env: Any = AcrobotEnv()
    env.dt, env.AVAIL_TORQUE = 0.005, Torque()
    noise = np.random.default_rng([sizes, seed])

    def coordinates(seen: Any) -> np.ndarray:
        q = np.arctan2(seen[[1, 3]], seen[[0, 2]]) + 2e-4 * noise.normal(size=2)
        return TURN * np.round(q / TURN)

    described = layout(("revolute", "revolute"), [1], goal=(np.pi, 0), hanging=(0, 0), rate=200.0, control=20.0)
    return gymnasium_plant(env, described, coordinates, action=lambda u: float(u[0]), seed=seed)


PLANTS: dict[str, Callable[[int, int], Plant]] = {
    "cart-pole": cart_pole,
    "acrobot": partial(_two_links, driven="elbow"),
    "pendubot": partial(_two_links, driven="shoulder"),
    "gymnasium-acrobot": gymnasium_acrobot,
    "rotary-pendulum": rotary_pendulum,
}
"""(seed of the sizes, seed of the start and the noise) -> plant, by name."""


SUBJECTS: dict[str, dict[str, Callable[[int, int], Plant]]] = {
    "foreign": PLANTS,
    "chains": CHAIN_PLANTS,
    "urdf": URDF_PLANTS,
}


def measured(
    subject: str, name: str, sizes: int, quick: bool = False, *, say: Callable[[str], None] = lambda _: None
) -> Findings:
    """Explores, learns, tunes and tries one plant."""
    make, case = partial(SUBJECTS[subject][name], sizes), f"{subject}/{name}/{sizes}"
    starts = 10 if quick else STARTS
    try:
        learned = learn_to_swing_up(make(0), seed=sizes, say=say)
    except InputError as error:
        say(str(error))
        return Findings([Row(case, "success_share", 0.0, bound=TO_REACH, at_least=True, expected=str(error)[:60])])
    trials, _ = try_plant(make, learned.tuned, starts=starts)
    seconds, tuned = trials.seconds[trials.up], learned.tuned
    words = f"of {starts} starts up within {SECONDS:g} s; 30 s of data"
    return Findings(
        [
            Row(case, "success_share", float(trials.up.mean()), bound=TO_REACH, at_least=True, expected=words),
            Row(case, "seconds_median", float(np.median(seconds)) if len(seconds) else np.inf, "s"),
            Row(case, "stopped", float(len(trials.stopped))),
            Row(case, "tuning_trials", float(tuned.trials)),
            Row(case, "tuning_worked", tuned.worked),
            Row(case, "tuning_margin", tuned.margin),
            Row(case, "delay", learned.prepared.delay, "samples"),
            Row(case, "episodes_stopped", float(len(learned.explored.stopped))),
            Row(case, "learning_seconds", learned.seconds, "s"),
        ]
    )


CASES: dict[str, Callable[[bool], Findings]] = {
    f"{subject}/{name}-{sizes}": partial(measured, subject, name, sizes)
    for subject, plants in SUBJECTS.items()
    for sizes in DRAWS
    for name in plants
}
"""Cases of the control report by name and draw of the sizes."""
