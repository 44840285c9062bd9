"""Plants from MJCF and URDF files, or MuJoCo models: layout, goal and limits are read from the model."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dln_jax.control.closed_loop import Hardware
from dln_jax.control.mujoco_loop import advance, sampling
from dln_jax.control.plants.plant import Layout, Plant, layout
from dln_jax.control.plants.postures import extremes
from dln_jax.control.plants.simulated import simulated
from dln_jax.data.robot_xml import driven_joints, parse_robot, velocity_limits
from dln_jax.data.robots import Robot, compile_robot, compiled_model, joint_names, quiet, require_ranges, robot_of
from dln_jax.types import InputError

MOST_JOINTS = 4


def mujoco_plant(
    source: Any,
    actuated: Sequence[int | str] = (),
    *,
    control: Any = None,
    goal: Any = None,
    hanging: Any = None,
    rate: float | None = None,
    speed: Any = None,
    hardware: Hardware = Hardware(),  # noqa: B008
    seed: int = 0,
) -> Plant:
    """Returns a simulated plant; a learner knows only its layout.

    Controls are forces of the joints. They act through the motors of the file and within their limits; a joint without
    an actuator gets them directly. The plant may have friction, drag, contacts and limits of joints. Refused are other
    actuators than motors, closed loops, springs, gravity compensation, wind and plugins.

    Args:
        source: path of an MJCF or URDF file, text of MJCF, or a `mujoco.MjModel`.
        actuated: joints with a motor, by name or number from 0; by default those with an actuator, or in a URDF with a
            transmission.
        control: largest forces of the motors, N m or N; by default those of the file, and not above them.
        goal: posture to hold [d]; by default the highest one, with slides in the middle of their ranges.
        hanging: posture of rest [d]; by default the lowest one.
        rate: sampling rate, Hz; by default one sample per time step.
        speed: largest rates, one or [d]; by default those of a URDF, as MJCF cannot state them.
        hardware: noise, resolution and delay.
        seed: seed of the starts and the noise.

    Raises:
        InputError: MuJoCo is missing or refuses the model; a joint is not a hinge or slide, or not in the file; the
            file has what is refused, or numbers that are not finite; a motor has no limits; there is no motor or no
            passive joint, or gravity does not move a passive joint; bodies touch at the goal or hanging; a sample is
            not a whole number of steps.
    """
    mujoco, model, data, controls, described, steps = _described(
        source, actuated, control, goal, rate, hanging, speed, passive=True
    )
    B = described.actuation
    applied = np.where(controls.any(axis=0)[:, None], 0.0, B)

    def begin(q: np.ndarray) -> None:
        mujoco.mj_resetData(model, data)
        data.qpos[:] = q

    def act(u: np.ndarray) -> None:
        data.ctrl[:] = controls @ B @ u
        data.qfrc_applied[:] = applied @ u
        advance(mujoco, model, data, steps)

    def kick(rates: np.ndarray) -> None:
        data.qvel[:] += rates

    return simulated(described, begin, lambda: data.qpos, act, kick=kick, hardware=hardware, seed=seed)


def layout_of_file(
    path: Path,
    actuated: Sequence[int | str] = (),
    *,
    control: Any = None,
    goal: Any = None,
    rate: float | None = None,
) -> Layout:
    """Returns the layout of an MJCF or URDF file, whose joints may all have a motor; arguments as `mujoco_plant`."""
    return _described(path, actuated, control, goal, rate)[4]


def _described(
    source: Any,
    actuated: Sequence[int | str],
    control: Any,
    goal: Any,
    rate: float | None,
    hanging: Any = None,
    speed: Any = None,
    passive: bool = False,
) -> tuple[Any, Any, Any, np.ndarray, Layout, int]:
    """Returns MuJoCo, its model, its data, controls of the file's actuators per force of a joint [nu, d], the layout of
    the plant, and the number of time steps in a sample."""
    mujoco, model, speeds, transmissions = _model(source)
    names = joint_names(model)
    speed = [speeds.get(name, np.inf) for name in names] if speed is None else speed
    for name, kind in zip(names, model.jnt_type, strict=True):
        if kind in (int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)):
            raise InputError(f"joint '{name}' is neither a hinge nor a slide; expected a plant with such joints only")
    if not 1 + passive <= len(names) <= MOST_JOINTS:
        which = f"2 to {MOST_JOINTS}, one of them passive" if passive else f"1 to {MOST_JOINTS}"
        raise InputError(f"the plant has {len(names)} joint(s); expected {which}")
    per_second, steps = sampling(model, rate)
    robot = robot_of(model, {})
    _require_known_forces(mujoco, model)
    joints, ranges = robot.tree.joints, robot.position_limits
    controls, largest = _motors(mujoco, model, robot)
    stated = actuated if len(actuated) else [name for name in transmissions if name in names]
    driven = _numbers(stated, names) if len(stated) else np.flatnonzero(controls.any(axis=0)).tolist()
    if not driven:
        raise InputError(
            "no joint has a motor: the file has no actuator (in a URDF, no transmission); name the joints with one "
            "(--actuated)"
        )
    data = mujoco.MjData(model)
    if goal is None or hanging is None:
        lowest, highest = extremes(lambda q: _potential(mujoco, model, data, q), joints, driven, ranges)
        goal = highest if goal is None else goal
        if hanging is None:
            hanging = lowest
            for k in sorted(set(range(len(joints))) - set(driven)) if passive else ():
                if hanging[k] in ranges[k]:
                    raise InputError(
                        f"'{names[k]}' cannot hang within its range of {ranges[k, 0]:.4g} to {ranges[k, 1]:.4g}, where "
                        "a swing-up starts; widen the range, or remove it"
                    )
    if control is None and not (passive and len(driven) == len(joints)):  # the layout refuses these
        for k in driven:
            if not 0 < largest[k] < np.inf:
                raise InputError(
                    f"the file states no limit of the motor of joint '{names[k]}'; give the largest force (--control), "
                    "or an actuatorfrcrange"
                )
        control = largest[driven]
    described = layout(
        joints, driven, goal=goal, hanging=hanging, rate=per_second, control=control, position=ranges, speed=speed,
        names=names, passive=passive,
    )  # fmt: skip
    for k, asked in zip(driven, described.limits.control[:, 1], strict=True):
        if asked > largest[k]:
            raise InputError(
                f"control is {asked:g}; the file limits the motor of joint '{names[k]}' to {largest[k]:g} N m or N"
            )
    for where, q in (("at the goal", described.goal), ("where the plant hangs", described.hanging)):
        _potential(mujoco, model, data, q)
        for pair in data.contact.geom[data.contact.dist < 0][:1]:
            first, second = (model.body(body).name or body for body in model.geom_bodyid[pair])
            raise InputError(
                f"bodies '{first}' and '{second}' touch {where}; exclude their contact, or move them apart"
            )
    return mujoco, model, data, controls, described, steps


def _require_known_forces(mujoco: Any, model: Any) -> None:
    """Raises `InputError` for forces that neither motors nor the potential of a chain explain, or disabled motors."""
    off = model.opt.disableactuator or model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    for what, present in {
        "disabled actuators": off and model.nu,
        "gravity compensation": model.body_gravcomp.any(),
        "wind": model.opt.wind.any(),
        "plugins": model.nplugin,
    }.items():
        if present:
            raise InputError(f"the file has {what}; expected a chain that only motors and gravity move")


def _model(source: Any) -> tuple[Any, Any, dict[str, float], list[str]]:
    """Returns MuJoCo, its model, and what a URDF states besides: largest rates by joint, joints with a transmission."""
    if isinstance(source, Path) or (isinstance(source, str) and not source.lstrip().startswith("<")):
        root = parse_robot(Path(source))
        mujoco, model = compile_robot(Path(source), root, (), inertias=True)[:2]
        if root.tag != "robot":
            return mujoco, model, {}, []
        # A URDF by itself states no integrator, and MuJoCo's default has errors that no rigid body makes.
        if root.find("mujoco/option") is None:
            model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
        return mujoco, model, velocity_limits(root), driven_joints(root)
    mujoco, model = compiled_model(source)
    require_ranges(model)
    return mujoco, model, {}, []


def _numbers(actuated: Sequence[int | str], names: Sequence[str]) -> list[int]:
    """Returns the numbers of joints from names or numbers."""
    chosen = []
    for joint in actuated:
        number = int(joint) if isinstance(joint, int) or (str(joint).isdecimal() and joint not in names) else None
        if (number is None and joint not in names) or (number is not None and number >= len(names)):
            known = ", ".join(f"{place} {name}" for place, name in enumerate(names))
            raise InputError(f"there is no joint '{joint}'; the joints are {known}")
        chosen.append(names.index(str(joint)) if number is None else number)
    return sorted(set(chosen))


def _motors(mujoco: Any, model: Any, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Returns controls of the actuators per force of a joint [nu, d], and the largest forces [d], infinite for none.

    Raises:
        InputError: an actuator is not the only motor of a joint, or its limits are not finite with zero inside.
    """
    largest = np.minimum(-robot.force_limits[:, 0], robot.force_limits[:, 1])
    controls = np.zeros((model.nu, model.njnt))
    for k in range(len(model.actuator_trntype)):
        name, gear, gain = model.actuator(k).name or k, model.actuator_gear[k], model.actuator_gainprm[k, 0]
        joint, force = model.actuator_trnid[k, 0], gear[0] * gain
        wrong = {  # MuJoCo numbers the kinds of a plain motor 0
            "its transmission": model.actuator_trntype[k],
            "its dyntype": model.actuator_dyntype[k],
            "its gaintype": model.actuator_gaintype[k],
            "its biastype": model.actuator_biastype[k],
            f"gear {gear.tolist()} and gain {gain:g}": gear[1:].any() or not 0 < abs(force) < np.inf,
            "another actuator has its joint": joint in np.flatnonzero(controls.any(axis=0)),
        }
        if reasons := [what for what, present in wrong.items() if present]:
            raise InputError(
                f"actuator '{name}' is not a plain motor of a joint ({reasons[0]}); make it a <motor> with a joint and "
                "one gear, or remove it and name the joint (--actuated, --control)"
            )
        controls[k, joint] = 1 / force
        for limited, (low, high), scale in (
            (model.actuator_ctrllimited[k], model.actuator_ctrlrange[k], abs(force)),
            (model.actuator_forcelimited[k], model.actuator_forcerange[k], abs(gear[0])),
        ):
            if limited or not (low == high == 0 or low < high):
                if not -np.inf < low < 0 < high < np.inf:
                    raise InputError(
                        f"actuator '{name}' has limits {low:g} to {high:g}; expected finite ones with zero between"
                    )
                largest[joint] = min(largest[joint], scale * min(-low, high))
    return controls, largest


def _potential(mujoco: Any, model: Any, data: Any, q: np.ndarray) -> float:
    data.qpos[:] = q
    with quiet(mujoco):
        mujoco.mj_fwdPosition(model, data)
    mujoco.mj_energyPos(model, data)
    return float(data.energy[0])
