"""Plants of random sizes from URDF files, as a user exports them: inertias, limits, damping and dry friction."""

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from dln_jax.control.closed_loop import Hardware
from dln_jax.control.plants.mujoco_plants import mujoco_plant
from dln_jax.control.plants.plant import Plant

RATE = 500.0
TURN = 2 * np.pi / 4096


def _link(name: str, mass: float, length: float, *, along: int = 2, sign: int = -1) -> str:
    """A rod whose joint is at its end; without a length a small body, which does not turn."""
    centre, inertia = np.zeros(3), np.full(3, mass * length**2 / 12 if length else 1e-3)
    centre[along] = sign * length / 2
    inertia[along] = 1e-7 if length else 1e-3
    ixx, iyy, izz = inertia
    return f"""<link name="{name}"><inertial><origin xyz="{" ".join(map(str, centre))}"/><mass value="{mass}"/>
      <inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""


def _joint(name: str, kind: str, links: tuple[str, str], axis: str, *, at: str = "0 0 0", limit: str = "",
           damping: float = 0.0, friction: float = 0.0) -> str:  # fmt: skip
    parent, child = links
    return f"""<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/>
      <axis xyz="{axis}"/>{limit}<dynamics damping="{damping}" friction="{friction}"/></joint>"""


def _plant(parts: list[str], driven: str, lab: Hardware, seed: int) -> Plant:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "plant.urdf"
        path.write_text(f'<robot name="plant"><link name="base"/>{"".join(parts)}</robot>')
        return mujoco_plant(path, [driven], rate=RATE, hardware=lab, seed=seed)


def cart_pole(sizes: int, seed: int) -> Plant:
    """A cart on a rail of 1.2 m, 10 N."""
    cart, pole, length = np.random.default_rng(sizes).uniform((0.5, 0.1, 0.3), (0.9, 0.2, 0.5))
    parts = [
        _link("cart", cart, 0.0),
        _link("pole", pole, length),
        _joint("rail", "prismatic", ("base", "cart"), "1 0 0", damping=0.1, friction=0.2,
               limit='<limit lower="-0.6" upper="0.6" effort="10" velocity="4"/>'),
        _joint("hinge", "continuous", ("cart", "pole"), "0 1 0", damping=5e-4),
    ]  # fmt: skip
    return _plant(parts, "rail", Hardware(encoder_step=np.array([2.5e-5, TURN]), control_noise=0.05, delay=1), seed)


def two_links(sizes: int, seed: int, driven: str) -> Plant:
    """An acrobot or a pendubot, 5 N m, with dry friction in both joints."""
    first, second, m1, m2 = np.random.default_rng(sizes).uniform((0.15, 0.25, 0.3, 0.3), (0.25, 0.35, 0.5, 0.5))
    limits = {driven: '<limit effort="5" velocity="60"/>'}
    joint = partial(_joint, damping=0.002, friction=0.005)
    parts = [
        _link("upper", m1, first),
        _link("lower", m2, second),
        joint("shoulder", "continuous", ("base", "upper"), "0 1 0", limit=limits.get("shoulder", "")),
        joint("elbow", "continuous", ("upper", "lower"), "0 1 0", at=f"0 0 -{first}", limit=limits.get("elbow", "")),
    ]  # fmt: skip
    return _plant(parts, driven, Hardware(encoder_step=TURN, control_noise=0.02, delay=1), seed)


def rotary_pendulum(sizes: int, seed: int) -> Plant:
    """A rotary pendulum with an arm that turns by 2.4 rad to either side, 0.05 N m."""
    arm, pole, length, height = np.random.default_rng(sizes).uniform((0.08, 0.02, 0.08, 0.1), (0.11, 0.03, 0.09, 0.14))
    parts = [
        _link("arm", arm, length, along=0, sign=1),
        _link("pole", pole, height),
        _joint("motor", "revolute", ("base", "arm"), "0 0 1", damping=1e-4, friction=1e-3,
               limit='<limit lower="-2.4" upper="2.4" effort="0.05" velocity="60"/>'),
        _joint("hinge", "continuous", ("arm", "pole"), "1 0 0", at=f"{length} 0 0", damping=1e-5),
    ]  # fmt: skip
    return _plant(parts, "motor", Hardware(encoder_step=TURN, control_noise=2.5e-4, delay=1), seed)


URDF_PLANTS: dict[str, Callable[[int, int], Plant]] = {
    "cart-pole": cart_pole,
    "acrobot": partial(two_links, driven="elbow"),
    "pendubot": partial(two_links, driven="shoulder"),
    "rotary-pendulum": rotary_pendulum,
}
"""(seed of the sizes, seed of the start and the noise) -> plant, by name."""
