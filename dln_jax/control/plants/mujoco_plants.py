"""Plants from MJCF and URDF files, or MuJoCo models: layout, goal and limits are read from the model."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dln_jax.control.closed_loop import Hardware
from dln_jax.control.mujoco_loop import compiled_model
from dln_jax.control.plants.plant import Layout, Plant, layout
from dln_jax.control.plants.postures import extremes
from dln_jax.control.plants.simulated import simulated
from dln_jax.data.robot_xml import driven_joints, parsed, velocity_limits
from dln_jax.data.robots import joint_names, opened, quiet
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

    Motors act as generalised forces of their joints, whatever actuators the file has.

    Args:
        source: path of an MJCF or URDF file, text of MJCF, or a `mujoco.MjModel`.
        actuated: joints with a motor, by name or number from 0; by default those with an actuator, or in a URDF with a
            transmission.
        control: largest forces of the motors, N m or N; by default those of the file.
        goal: posture to hold [d]; by default the highest one.
        hanging: posture of rest [d]; by default the lowest one.
        rate: sampling rate, Hz; by default one sample per time step.
        speed: largest rates, one or [d]; by default those of a URDF, as MJCF cannot state them.
        hardware: noise, resolution and delay.
        seed: seed of the starts and the noise.

    Raises:
        InputError: MuJoCo is missing or refuses the model; a joint is not a hinge or slide, or not in the file; a motor
            has no limits; there is no motor or no passive joint, or gravity does not move a passive joint; a sample is
            not a whole number of steps.
    """
    mujoco, model, data, described, steps = _described(source, actuated, control, goal, hanging, rate, speed, True)
    return _plant(mujoco, model, data, described, steps, hardware, seed)


def layout_of_file(
    path: Path,
    actuated: Sequence[int | str] = (),
    *,
    control: Any = None,
    goal: Any = None,
    rate: float | None = None,
) -> Layout:
    """Returns the layout of an MJCF or URDF file, whose joints may all have a motor; arguments as `mujoco_plant`."""
    return _described(path, actuated, control, goal, None, rate, None, False)[3]


def _described(
    source: Any,
    actuated: Sequence[int | str],
    control: Any,
    goal: Any,
    hanging: Any,
    rate: float | None,
    speed: Any,
    passive: bool,
) -> tuple[Any, Any, Any, Layout, int]:
    """Returns MuJoCo, its model, its data, the layout of the plant, and the number of time steps in a sample."""
    mujoco, model, speeds, transmissions = _model(source)
    names = joint_names(model)
    speed = [speeds.get(name, np.inf) for name in names] if speed is None else speed
    kinds = {int(mujoco.mjtJoint.mjJNT_HINGE): "revolute", int(mujoco.mjtJoint.mjJNT_SLIDE): "prismatic"}
    for name, kind in zip(names, map(int, model.jnt_type), strict=True):
        if kind not in kinds:
            raise InputError(f"joint '{name}' is neither a hinge nor a slide; expected a plant with such joints only")
    if not 1 + passive <= len(names) <= MOST_JOINTS:
        which = f"2 to {MOST_JOINTS}, one of them passive" if passive else f"1 to {MOST_JOINTS}"
        raise InputError(f"the plant has {len(names)} joint(s); expected {which}")
    joints = [kinds[int(kind)] for kind in model.jnt_type]
    stated = actuated if len(actuated) else [name for name in transmissions if name in names]
    driven = _numbers(stated, names) if len(stated) else sorted(_actuators(mujoco, model))
    per_second = float(1 / model.opt.timestep if rate is None else rate)
    steps = 1 / (per_second * model.opt.timestep)
    if abs(steps - round(steps)) > 1e-6 or round(steps) < 1:
        raise InputError(f"a sample has {steps:.4g} steps of {model.opt.timestep:g} s; expected a whole number")
    data = mujoco.MjData(model)
    ranges = np.where(np.asarray(model.jnt_limited, bool)[:, None], model.jnt_range, [-np.inf, np.inf])
    if goal is None or hanging is None:
        lowest, highest = extremes(lambda q: _potential(mujoco, model, data, q), joints, driven, ranges)
        goal = highest if goal is None else goal
        if hanging is None:
            hanging = lowest
            _require_free_hanging(hanging, ranges, set(range(len(joints))) - set(driven) if passive else set(), names)
    refused = passive and len(driven) == len(joints)  # by the layout
    size = _control(mujoco, model, driven, names) if control is None and not refused else control
    described = layout(
        joints, driven, goal=goal, hanging=hanging, rate=per_second, control=size, position=ranges, speed=speed,
        names=names, passive=passive,
    )  # fmt: skip
    return mujoco, model, data, described, round(steps)


def _require_free_hanging(
    hanging: np.ndarray, ranges: np.ndarray, passive: Collection[int], names: Sequence[str]
) -> None:
    """Raises `InputError` if a passive joint cannot hang, because its lowest position is a limit of its range."""
    for k in sorted(passive):
        if hanging[k] in ranges[k]:
            raise InputError(
                f"'{names[k]}' cannot hang within its range of {ranges[k, 0]:.4g} to {ranges[k, 1]:.4g}, where a "
                "swing-up starts; widen the range, or remove it"
            )


def _plant(mujoco: Any, model: Any, data: Any, described: Layout, steps: int, hardware: Hardware, seed: int) -> Plant:
    B = described.actuation
    warnings = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)

    def begin(q: np.ndarray) -> None:
        mujoco.mj_resetData(model, data)
        data.qpos[:] = q

    def advance(u: np.ndarray) -> None:
        data.qfrc_applied[:] = B @ u
        with quiet(mujoco):
            mujoco.mj_step(model, data, steps)
        # MuJoCo resets when it diverges, which would hide a failure.
        if any(data.warning[kind].number for kind in warnings):
            data.qpos[:] = np.nan

    def kick(rates: np.ndarray) -> None:
        data.qvel[:] += rates

    return simulated(described, begin, lambda: data.qpos, advance, kick=kick, hardware=hardware, seed=seed)


def _model(source: Any) -> tuple[Any, Any, dict[str, float], list[str]]:
    """Returns MuJoCo, its model, and what a URDF states besides: largest rates by joint, joints with a transmission."""
    if isinstance(source, Path) or (isinstance(source, str) and not source.lstrip().startswith("<")):
        root = parsed(Path(source))
        mujoco, model = opened(Path(source), root, (), inertias=True)[:2]
        if root.tag != "robot":
            return mujoco, model, {}, []
        # A URDF states no integrator, and MuJoCo's default has errors that no rigid body makes.
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
        return mujoco, model, velocity_limits(root), driven_joints(root)
    return *compiled_model(source), {}, []


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


def _actuators(mujoco: Any, model: Any) -> dict[int, float]:
    """Returns the largest forces of joints with actuators, by number of the joint; infinite if the file states none."""
    of_joint = int(mujoco.mjtTrn.mjTRN_JOINT)
    forces: dict[int, float] = {}
    for k in range(model.nu):
        if int(model.actuator_trntype[k]) == of_joint:
            size = np.inf
            if model.actuator_forcelimited[k]:
                size = float(np.abs(model.actuator_forcerange[k]).min())
            elif model.actuator_ctrllimited[k]:
                size = float(np.abs(model.actuator_ctrlrange[k]).min() * abs(model.actuator_gainprm[k, 0]))
            forces[int(model.actuator_trnid[k, 0])] = size * abs(float(model.actuator_gear[k, 0]))
    return forces


def _control(mujoco: Any, model: Any, driven: Sequence[int], names: Sequence[str]) -> list[float]:
    motors, sizes = _actuators(mujoco, model), []
    for k in driven:
        limited = float(np.abs(model.jnt_actfrcrange[k]).min()) if model.jnt_actfrclimited[k] else np.inf
        sizes.append(min(limited, motors.get(k, np.inf)))
        if not 0 < sizes[-1] < np.inf:
            raise InputError(
                f"the file states no limit of the motor of joint '{names[k]}'; give the largest force (--control), or "
                "an actuatorfrcrange"
            )
    return sizes


def _potential(mujoco: Any, model: Any, data: Any, q: np.ndarray) -> float:
    data.qpos[:] = q
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_energyPos(model, data)
    return float(data.energy[0])
