"""Swing-ups of plants that share no equation with this library, from 30 s of noisy data each, without a gain by hand.

MJCF and URDF files of random sizes, Gymnasium's acrobot, and a rotary pendulum whose samples are late by chance.
"""

import math
import random
import tempfile
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dln_jax.commands.learned_plants import SECONDS, Learned, learn_to_swing_up, try_plant
from dln_jax.control.closed_loop import Hardware
from dln_jax.control.plants.mujoco_plants import mujoco_plant
from dln_jax.control.plants.outside_loops import gymnasium_plant, hardware_plant
from dln_jax.control.plants.plant import Plant, layout
from dln_jax.control.plants.runs import Trials, compiled, judged_runs, run, start_of
from dln_jax.types import InputError
from scripts.reports.run import Numbers

TURN = 2 * np.pi / 4096
RAIL = np.array([2.5e-5, TURN])
"""Resolutions of the encoders of rail and hinge, m and rad."""
LARGEST = 0.05
"""Largest torque of the late pendulum, N m."""


class LatePendulum:
    """A rotary pendulum on a simulated clock: motors follow 10 ms late, samples by exponentially distributed times.

    `mean` is the mean lateness of samples, s, of at most 9 ms.
    """

    def __init__(self, mean: float) -> None:
        self.mean, self.now, self.noise = mean, 0.0, random.Random(0)
        self.reset()

    def reset(self) -> None:
        """Replaces the pendulum by one that hangs near rest."""
        self.simulated, self.torque, self.commands = self.now, 0.0, deque()
        self.q, self.v = [self.noise.gauss(0, 0.05), math.pi + self.noise.gauss(0, 0.05)], [0.0, 0.0]

    def sleep(self, seconds: float) -> None:
        """Waits, and longer."""
        self.now += seconds + (min(self.noise.expovariate(1 / self.mean), 9e-3) if self.mean else 0.0)

    def write(self, u: np.ndarray) -> None:
        """Sends a torque, which follows late."""
        self.commands.append((self.now + 3e-4, max(-LARGEST, min(LARGEST, float(u[0])))))

    def read(self) -> np.ndarray:
        """Measured angles of arm and pole, with noise of 1 mrad."""
        self.now += 2e-4
        while self.simulated + 5e-4 <= self.now:
            while self.commands and self.commands[0][0] + 0.010 <= self.simulated:
                self.torque = self.commands.popleft()[1]
            rates = accelerations(self.q, self.v, self.torque)
            self.v = [rate + 5e-4 * change for rate, change in zip(self.v, rates, strict=True)]
            self.q = [angle + 5e-4 * rate for angle, rate in zip(self.q, self.v, strict=True)]
            self.simulated += 5e-4
        return np.array([math.remainder(angle + 1e-3 * self.noise.gauss(), 2 * math.pi) for angle in self.q])


def accelerations(q: list[float], v: list[float], torque: float) -> tuple[float, float]:
    """The accelerations of arm and pole, rad/s², of the late pendulum, with dry friction of the arm."""
    coupling, weight, sine, cosine = 1.3e-4, 1.52e-2, math.sin(q[1]), math.cos(q[1])
    a, b, c = 2.6e-4 + 1e-4 * sine**2, coupling * cosine, 1.33e-4
    friction = 1e-4 * v[0] + 1e-3 * math.tanh(v[0] / 0.02)
    first = torque - 2e-4 * sine * cosine * v[0] * v[1] + coupling * sine * v[1] ** 2 - friction
    second = 1e-4 * sine * cosine * v[0] ** 2 + weight * sine - 8e-5 * v[1]
    determinant = a * c - b * b
    return (c * first - b * second) / determinant, (a * second - b * first) / determinant


def drawn(sizes: int, low: tuple[float, ...], high: tuple[float, ...]) -> np.ndarray:
    """Random sizes by a seed."""
    return np.random.default_rng(sizes).uniform(low, high)


def mjcf(body: str, driven: list[Any], control, noise: float, seed: int, encoder: Any = TURN) -> Plant:
    """A plant in MuJoCo, without contacts, with encoders, noise and a sample of delay."""
    text = f"""<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="RK4"/>
      <default><geom contype="0" conaffinity="0"/></default><worldbody>{body}</worldbody></mujoco>"""
    lab = Hardware(encoder_step=encoder, control_noise=noise, delay=1)
    return mujoco_plant(text, driven, control=control, hardware=lab, seed=seed)


def cart_pole(sizes: int, seed: int) -> Plant:
    """A cart on a rail of 1.2 m with a rod; masses and length by chance."""
    cart, pole, length = drawn(sizes, (0.4, 0.08, 0.25), (1.0, 0.2, 0.5))
    body = f"""<body>
      <joint name="rail" type="slide" axis="1 0 0" range="-0.6 0.6" limited="true" damping="0.1" frictionloss="0.2"/>
      <geom type="box" size=".05 .04 .03" mass="{cart}"/>
      <body><joint name="hinge" axis="0 1 0" damping="5e-4"/>
      <geom type="capsule" fromto="0 0 0 0 0 -{length}" size=".01" mass="{pole}"/></body></body>"""
    return mjcf(body, ["rail"], 10.0, 0.05, seed, RAIL)


def two_links(sizes: int, seed: int, driven: str) -> Plant:
    """An acrobot or a pendubot."""
    first, second, m1, m2 = drawn(sizes, (0.15, 0.2, 0.3, 0.3), (0.25, 0.35, 0.6, 0.6))
    body = f"""<body><joint name="shoulder" axis="0 1 0" damping="0.002"/>
      <geom type="capsule" fromto="0 0 0 0 0 -{first}" size=".015" mass="{m1}"/>
      <body pos="0 0 -{first}"><joint name="elbow" axis="0 1 0" damping="0.002"/>
      <geom type="capsule" fromto="0 0 0 0 0 -{second}" size=".015" mass="{m2}"/></body></body>"""
    return mjcf(body, [driven], 5.0, 0.02, seed)


def rotary_pendulum(sizes: int, seed: int) -> Plant:
    """A rotary pendulum whose base is tilted by 4 degrees about a random level axis."""
    turn = drawn(sizes, (0.0,), (2 * np.pi,))[0]
    x, y = np.deg2rad(4.0) * np.array([np.cos(turn), np.sin(turn)])
    body = f"""<body euler="{x} {y} 0">
      <joint name="arm" axis="0 0 1" damping="1e-4" frictionloss="1e-3"/>
      <geom type="capsule" fromto="0 0 0 .085 0 0" size=".006" mass=".095"/>
      <body pos=".085 0 0"><joint name="pole" axis="1 0 0" damping="1e-5"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.129" size=".004" mass=".024"/></body></body>"""
    return mjcf(body, ["arm"], 0.05, 2.5e-4, seed)


def chain(sizes: int, seed: int, passive: int) -> Plant:
    """A chain of three links in a plane with motors on two of its joints."""
    low, high = (0.25, 0.25, 0.2, 0.3, 0.2, 0.15), (0.35, 0.35, 0.3, 0.5, 0.4, 0.25)
    l1, l2, l3, m1, m2, m3 = drawn(sizes, low, high)
    dry = np.where(np.arange(3) == passive, 0.0, 0.01)
    body = f"""<body><joint name="0" axis="0 1 0" damping="0.003" frictionloss="{dry[0]}"/>
      <geom type="capsule" fromto="0 0 0 0 0 -{l1}" size=".012" mass="{m1}"/>
      <body pos="0 0 -{l1}"><joint name="1" axis="0 1 0" damping="0.003" frictionloss="{dry[1]}"/>
      <geom type="capsule" fromto="0 0 0 0 0 -{l2}" size=".012" mass="{m2}"/>
      <body pos="0 0 -{l2}"><joint name="2" axis="0 1 0" damping="0.003" frictionloss="{dry[2]}"/>
      <geom type="capsule" fromto="0 0 0 0 0 -{l3}" size=".012" mass="{m3}"/></body></body></body>"""
    driven = [k for k in range(3) if k != passive]
    return mjcf(body, driven, np.array([4.0, 2.0, 1.0])[driven], 0.02, seed)


def gymnasium_acrobot(sizes: int, seed: int) -> Plant:
    """The acrobot of Gymnasium, 1 m and 1 kg a link, with any torque up to 20 N m, at 200 Hz, with encoders."""
    from gymnasium.envs.classic_control import AcrobotEnv

    class Torque:
        def __getitem__(self, torque):
            return torque

    env: Any = AcrobotEnv()
    env.dt, env.AVAIL_TORQUE = 0.005, Torque()
    noise = np.random.default_rng([sizes, seed])

    def coordinates(seen):
        q = np.arctan2(seen[[1, 3]], seen[[0, 2]]) + 2e-4 * noise.normal(size=2)
        return TURN * np.round(q / TURN)

    described = layout(("revolute", "revolute"), [1], goal=(np.pi, 0), hanging=(0, 0), rate=200.0, control=20.0)
    return gymnasium_plant(env, described, coordinates, action=lambda u: float(u[0]), seed=seed)


def urdf(parts: str, driven: str, noise: float, seed: int, encoder: Any = TURN) -> Plant:
    """A plant from a URDF file, as a user exports it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "plant.urdf"
        path.write_text(f'<robot name="plant"><link name="base"/>{parts}</robot>')
        lab = Hardware(encoder_step=encoder, control_noise=noise, delay=1)
        return mujoco_plant(path, [driven], rate=500.0, hardware=lab, seed=seed)


def link(name: str, mass: float, centre: str, ixx: float, iyy: float, izz: float) -> str:
    """A link in URDF; centre in m, inertias in kg m²."""
    return f"""<link name="{name}"><inertial><origin xyz="{centre}"/><mass value="{mass}"/>
      <inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""


def rod(name: str, mass: float, length: float) -> str:
    """A rod that hangs from its joint."""
    across = mass * length**2 / 12
    return link(name, mass, f"0 0 {-length / 2}", across, across, 1e-7)


def urdf_cart_pole(sizes: int, seed: int) -> Plant:
    """A cart on a rail of 1.2 m, 10 N."""
    cart, pole, length = drawn(sizes, (0.5, 0.1, 0.3), (0.9, 0.2, 0.5))
    parts = f"""{link("cart", cart, "0 0 0", 1e-3, 1e-3, 1e-3)}{rod("pole", pole, length)}
      <joint name="rail" type="prismatic"><parent link="base"/><child link="cart"/><axis xyz="1 0 0"/>
        <limit lower="-0.6" upper="0.6" effort="10" velocity="4"/><dynamics damping="0.1" friction="0.2"/></joint>
      <joint name="hinge" type="continuous"><parent link="cart"/><child link="pole"/><axis xyz="0 1 0"/>
        <dynamics damping="5e-4" friction="0"/></joint>"""
    return urdf(parts, "rail", 0.05, seed, RAIL)


def urdf_two_links(sizes: int, seed: int, driven: str) -> Plant:
    """An acrobot or a pendubot, 5 N m, with dry friction in both joints."""
    first, second, m1, m2 = drawn(sizes, (0.15, 0.25, 0.3, 0.3), (0.25, 0.35, 0.5, 0.5))
    shoulder, elbow = ('<limit effort="5" velocity="60"/>' if driven == name else "" for name in ("shoulder", "elbow"))
    parts = f"""{rod("upper", m1, first)}{rod("lower", m2, second)}
      <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
        {shoulder}<dynamics damping="0.002" friction="0.005"/></joint>
      <joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/><origin xyz="0 0 -{first}"/>
        <axis xyz="0 1 0"/>{elbow}<dynamics damping="0.002" friction="0.005"/></joint>"""
    return urdf(parts, driven, 0.02, seed)


def urdf_rotary_pendulum(sizes: int, seed: int) -> Plant:
    """A rotary pendulum with an arm that turns by 2.4 rad to either side, 0.05 N m."""
    arm, pole, length, height = drawn(sizes, (0.08, 0.02, 0.08, 0.1), (0.11, 0.03, 0.09, 0.14))
    across = arm * length**2 / 12
    parts = f"""{link("arm", arm, f"{length / 2} 0 0", 1e-7, across, across)}{rod("pole", pole, height)}
      <joint name="motor" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
        <limit lower="-2.4" upper="2.4" effort="0.05" velocity="60"/><dynamics damping="1e-4" friction="1e-3"/></joint>
      <joint name="hinge" type="continuous"><parent link="arm"/><child link="pole"/><origin xyz="{length} 0 0"/>
        <axis xyz="1 0 0"/><dynamics damping="1e-5" friction="0"/></joint>"""
    return urdf(parts, "motor", 2.5e-4, seed)


PLANTS: dict[str, Callable[[int, int], Plant]] = {
    "foreign/cart-pole": cart_pole,
    "foreign/acrobot": partial(two_links, driven="elbow"),
    "foreign/pendubot": partial(two_links, driven="shoulder"),
    "foreign/gymnasium-acrobot": gymnasium_acrobot,
    "foreign/rotary-pendulum": rotary_pendulum,
    "chains/passive-first": partial(chain, passive=0),
    "chains/passive-middle": partial(chain, passive=1),
    "chains/passive-last": partial(chain, passive=2),
    "urdf/cart-pole": urdf_cart_pole,
    "urdf/acrobot": partial(urdf_two_links, driven="elbow"),
    "urdf/pendubot": partial(urdf_two_links, driven="shoulder"),
    "urdf/rotary-pendulum": urdf_rotary_pendulum,
}
"""(seed of the sizes, seed of the start and the noise) -> plant, by name."""


def swing_up(*, plant: str, sizes: int, starts: int = 100) -> Numbers:
    """Explores, learns, tunes and tries one plant; no start of a plant that cannot be learned comes up."""
    make, case = partial(PLANTS[plant], sizes), f"{plant}/{sizes}"
    try:
        learned = learn_to_swing_up(make(0), seed=sizes)
    except InputError as refusal:
        print(refusal, flush=True)
        return {case: {"success_share": 0.0}}
    return {case: success(try_plant(make, learned.law, starts=starts)[0], learned)}


def success(trials: Trials, learned: Learned) -> dict[str, float]:
    """Numbers of trials of a learned plant."""
    return {
        "success_share": np.mean(trials.up),
        "seconds_median": np.median(trials.seconds[trials.up]) if trials.up.any() else np.inf,
        "stopped": len(trials.stopped),
        "delay": learned.prepared.delay,
        "tuning_margin": learned.law.margin,
        "learning_seconds": learned.seconds,
    }


def late_samples(*, milliseconds: int, starts: int = 20) -> Numbers:
    """The late pendulum, which is explored, learned and tried from one start after the other."""
    late, joints = LatePendulum(1e-3 * milliseconds), ("revolute", "revolute")
    ranges: Any = {"position": [[-2.5, 2.5], [-np.inf, np.inf]], "speed": (40.0, 60.0)}
    described = layout(joints, [0], goal=(0, 0), hanging=(0, np.pi), rate=100.0, control=LARGEST, **ranges)
    settings = {"reset": late.reset, "read": late.read, "write": late.write, "sleep": late.sleep}
    plant = hardware_plant(described, **settings, clock=lambda: late.now)
    learned = learn_to_swing_up(plant, seed=0)
    act, memory = compiled(learned.law.controller, plant.layout), start_of(learned.law.controller, 1)
    runs = [run([plant], act, memory, seconds=SECONDS)[0] for _ in range(starts)]
    return {f"rig/late-by-{milliseconds}-ms": success(judged_runs(runs, plant.layout, seconds=SECONDS), learned)}
