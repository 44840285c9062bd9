"""Plants from MJCF and URDF files, or models of MuJoCo: layout, goal and limits are read from the model."""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dln_jax.control.closed_loop import Hardware
from dln_jax.control.mujoco_loop import compiled_model
from dln_jax.control.plants.plant import Layout, Plant, layout
from dln_jax.control.plants.simulated import simulated
from dln_jax.data.robot_xml import parsed
from dln_jax.data.robots import joint_names, opened, quiet
from dln_jax.types import InputError

TURNS = 8
"""Angles of a joint from which the highest and the lowest posture are sought."""
MOST_JOINTS = 4
LEVEL = 1e-3
"""Smallest share of the model's weight times its size that counts as a potential of a passive joint."""


def mujoco_plant(
    source: Any,
    actuated: Sequence[int | str] = (),
    *,
    control: Any = None,
    goal: Any = None,
    hanging: Any = None,
    rate: float | None = None,
    speed: Any = np.inf,
    hardware: Hardware = Hardware(),  # noqa: B008
    seed: int = 0,
) -> Plant:
    """Returns a simulated plant; only its layout is known to whoever learns it.

    Motors act as generalised forces of their joints, whatever actuators the file has.

    Args:
        source: path of an MJCF or URDF file, text of MJCF, or a `mujoco.MjModel`.
        actuated: joints with a motor, by name or number from 0; by default those on which an actuator acts.
        control: largest size of the motors' forces, N m or N; by default that of the file.
        goal: posture to hold [d]; by default the highest one.
        hanging: posture of rest [d]; by default the lowest one.
        rate: of the samples, Hz; by default one sample a time step.
        speed: largest rates, one or [d].
        hardware: noise, resolution and delay.
        seed: of the starts and the noise.

    Raises:
        InputError: MuJoCo is missing or refuses the model; a joint that is no hinge or slide, or not in the file;
            motors without limits; a plant without a motor or a passive joint, or whose passive joints no gravity moves;
            a sample that is not a whole number of steps.
    """
    mujoco, model = _model(source)
    names = joint_names(model)
    kinds = {int(mujoco.mjtJoint.mjJNT_HINGE): "revolute", int(mujoco.mjtJoint.mjJNT_SLIDE): "prismatic"}
    for name, kind in zip(names, map(int, model.jnt_type), strict=True):
        if kind not in kinds:
            raise InputError(f"joint '{name}' is neither a hinge nor a slide; expected a plant of such joints alone")
    if not 2 <= len(names) <= MOST_JOINTS:
        raise InputError(f"the plant has {len(names)} joint(s); expected 2 to {MOST_JOINTS}, one of them passive")
    joints = [kinds[int(kind)] for kind in model.jnt_type]
    driven = _numbers(actuated, names) if len(actuated) else sorted(_actuators(mujoco, model))
    per_second = float(1 / model.opt.timestep if rate is None else rate)
    steps = 1 / (per_second * model.opt.timestep)
    if abs(steps - round(steps)) > 1e-6 or round(steps) < 1:
        raise InputError(f"a sample has {steps:.4g} steps of {model.opt.timestep:g} s; expected a whole number")
    data = mujoco.MjData(model)
    ranges = np.where(np.asarray(model.jnt_limited, bool)[:, None], model.jnt_range, [-np.inf, np.inf])
    if goal is None or hanging is None:
        lowest, highest = _extremes(mujoco, model, data, joints, driven, ranges)
        goal, hanging = highest if goal is None else goal, lowest if hanging is None else hanging
    passive = len(driven) < len(joints)  # else the layout is refused
    size = _control(mujoco, model, driven, names) if control is None and passive else control
    described = layout(
        joints, driven, goal=goal, hanging=hanging, rate=per_second, control=size, position=ranges, speed=speed,
        names=names,
    )  # fmt: skip
    return _plant(mujoco, model, data, described, round(steps), hardware, seed)


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

    return simulated(described, begin, lambda: data.qpos, advance, hardware=hardware, seed=seed)


def _model(source: Any) -> tuple[Any, Any]:
    if isinstance(source, Path) or (isinstance(source, str) and not source.lstrip().startswith("<")):
        return opened(Path(source), parsed(Path(source)), ())[:2]
    return compiled_model(source)


def _numbers(actuated: Sequence[int | str], names: Sequence[str]) -> list[int]:
    """Numbers of joints that are given by name or number."""
    chosen = []
    for joint in actuated:
        number = int(joint) if isinstance(joint, int) or (str(joint).isdigit() and joint not in names) else None
        if (number is None and joint not in names) or (number is not None and number >= len(names)):
            known = ", ".join(f"{place} {name}" for place, name in enumerate(names))
            raise InputError(f"there is no joint '{joint}'; the joints are {known}")
        chosen.append(names.index(str(joint)) if number is None else number)
    return sorted(set(chosen))


def _actuators(mujoco: Any, model: Any) -> dict[int, float]:
    """Largest forces of the joints on which actuators act, by number; infinite where the file states none."""
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


def _extremes(
    mujoco: Any, model: Any, data: Any, joints: Sequence[str], driven: Sequence[int], ranges: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Postures of least and of greatest potential energy; coordinates that do not matter stay at zero."""
    from scipy.optimize import minimize

    def potential(q: np.ndarray) -> float:
        data.qpos[:] = q
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_energyPos(model, data)
        return float(data.energy[0])

    turns = 2 * np.pi / TURNS * np.arange(1 - TURNS // 2, TURNS // 2 + 1)
    choices = [
        [turn for turn in turns if low <= turn <= high] if kind == "revolute" else [float(np.clip(0.0, low, high))]
        for kind, (low, high) in zip(joints, ranges, strict=True)
    ]
    grid = sorted(map(np.array, itertools.product(*choices)), key=lambda q: float(np.abs(q).sum()))
    if not grid:
        raise InputError("the limits of the joints exclude every posture of the search; give goal and hanging")
    energies = np.array([potential(q) for q in grid])
    size = float(np.ptp(energies))
    for k in sorted(set(range(len(joints))) - set(driven)):
        moved = [
            abs(potential(q + np.pi / 2 * np.eye(len(joints))[k]) - e) for q, e in zip(grid, energies, strict=True)
        ]
        if not max(moved) > LEVEL * max(size, 1e-12):
            raise InputError(f"gravity does not move the passive joint {k}; expected a plant that hangs and stands")
    postures = []
    for sign in (1.0, -1.0):
        ties = np.flatnonzero(sign * energies <= (sign * energies).min() + 1e-9 * max(size, 1e-12))
        best = minimize(lambda q: sign * potential(q) / size, grid[ties[0]], method="BFGS", options={"gtol": 1e-7})  # noqa: B023
        postures.append(np.clip(np.where(np.abs(best.x) < 1e-9, 0.0, best.x), ranges[:, 0], ranges[:, 1]))
    return postures[0], postures[1]
