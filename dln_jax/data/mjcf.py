"""Writes a robot as MJCF text, which MuJoCo simulates and `read_robot` reads back."""

import xml.etree.ElementTree as ET
from typing import Any

import numpy as np

from dln_jax.data.robots import Robot
from dln_jax.mechanics.trees.inertia import parts
from dln_jax.types import InputError, require_positive


def mjcf(robot: Robot, *, time_step: float = 0.001) -> str:
    """MJCF text of a robot, with one body per link, one motor per joint and contacts disabled.

    Args:
        robot: robot to write; infinite limits are left out.
        time_step: time step of the simulation, s.

    Raises:
        InputError: a link has no mass, which MuJoCo refuses, or the time step is not positive.
    """
    require_positive(time_step=time_step)
    tree = robot.tree
    names = tree.names or tuple(f"joint_{link}" for link in range(tree.degrees_of_freedom))
    root = ET.Element("mujoco")
    ET.SubElement(root, "compiler", angle="radian", autolimits="true")
    option = ET.SubElement(
        root, "option", gravity=_text(tree.gravity), timestep=_text(time_step), integrator="implicitfast"
    )
    ET.SubElement(option, "flag", contact="disable")
    world, motors = ET.SubElement(root, "worldbody"), ET.SubElement(root, "actuator")
    bodies: list[ET.Element] = []
    for link, (name, parent) in enumerate(zip(names, tree.parents, strict=True)):
        place = {"pos": _text(tree.positions[link]), **_turn(tree.rotations[link])}
        body = ET.SubElement(bodies[parent] if parent >= 0 else world, "body", {"name": f"link_{name}", **place})
        bodies.append(body)
        ET.SubElement(body, "inertial", _inertial(name, tree.inertias[link]))
        kind = "hinge" if tree.joints[link] == "revolute" else "slide"
        numbers = {"armature": tree.armature, "damping": robot.damping, "frictionloss": robot.coulomb}
        stated = {key: _text(each[link]) for key, each in numbers.items()}
        for key, limits in (("range", robot.position_limits[link]), ("actuatorfrcrange", robot.force_limits[link])):
            if np.isfinite(limits).all():
                stated[key] = _text(limits)
        ET.SubElement(body, "joint", {"name": name, "type": kind, "axis": _text(tree.axes[link]), **stated})
        ET.SubElement(motors, "motor", name=f"motor_{name}", joint=name)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _inertial(name: str, theta: Any) -> dict[str, str]:
    """Mass, centre of mass, and moments of inertia about it."""
    m, h, moments = parts(np.asarray(theta, float))
    if not m > 0:
        raise InputError(f"the link of joint '{name}' has a mass of {m:.3g} kg; expected a positive one in MJCF")
    c = h / m
    about = moments - m * (c @ c * np.eye(3) - np.outer(c, c))
    return {"mass": _text(m), "pos": _text(c), "fullinertia": _text(about[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])}


def _turn(rotation: Any) -> dict[str, str]:
    """A rotation as its first two columns, which keep all digits; empty for the identity."""
    return {} if np.array_equal(rotation, np.eye(3)) else {"xyaxes": _text(np.asarray(rotation)[:, :2].T)}


def _text(numbers: Any) -> str:
    return " ".join(f"{each:.17g}" for each in np.ravel(np.asarray(numbers, float)))
