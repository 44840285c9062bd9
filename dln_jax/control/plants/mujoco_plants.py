"""Plants from MJCF and URDF files, or MuJoCo models: layout, goal and limits are read from the model."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import Array

from dln_jax.control.closed_loop import ClosedLoopRun, Controller, Hardware, simulate
from dln_jax.control.plants.plant import Plant, extremes, layout, simulated
from dln_jax.data.robot_xml import driven_joints, parse_robot, velocity_limits
from dln_jax.data.robots import Robot, compile_robot, compiled_model, joint_names, quiet, require_ranges, robot_of
from dln_jax.types import InputError, require_positive

MOST_JOINTS = 4
SUFFIXES = (".xml", ".mjcf", ".urdf")
OTHER_NAMES = {"furuta": "rotary-pendulum", "cartpole": "cart-pole"}


def plant_file(folder: Path, plant: str) -> Path:
    """Returns the file of a folder's plant by its name, or a path; raises InputError if it is neither."""
    names = [path.stem for path in sorted(folder.glob("*.xml"))]
    if (name := OTHER_NAMES.get(plant, plant)) in names:
        return folder / f"{name}.xml"
    if Path(plant).suffix.lower() in SUFFIXES or Path(plant).is_file():
        return Path(plant)
    raise InputError(f"plant is {plant!r:.40}; choose from {', '.join(names)}, or give the path of a file")


def mujoco_plant(
    source: Any,
    actuated: Sequence[int | str] = (),
    *,
    control: Any = None,
    goal: Any = None,
    hanging: Any = None,
    rate: float | None = None,
    speed: Any = None,
    passive: bool = True,
    hardware: Hardware = Hardware(),  # noqa: B008
    seed: int = 0,
) -> Plant:
    """Returns a simulated plant; a learner knows only its layout.

    Controls are joint forces. They act through the motors of the file, within their limits, or directly on joints
    without an actuator. The plant may have friction, drag, contacts and joint limits. Actuators other than motors,
    closed loops, springs, gravity compensation, wind and plugins are refused.

    Args:
        source: path of an MJCF or URDF file, text of MJCF, or a `mujoco.MjModel`.
        actuated: joints with a motor, by name or number from 0; by default those with an actuator, or in a URDF with a
            transmission.
        control: largest forces of the motors, N m or N; by default the limits of the file, which they must not exceed.
        goal: posture to hold [d]; by default the highest posture, with slides in the middle of their ranges.
        hanging: posture at rest [d]; by default the lowest posture.
        rate: sampling rate, Hz; by default one sample per time step.
        speed: largest rates, one or [d]; by default the URDF's limits (MJCF has none).
        passive: require a joint without a motor, as for a swing-up.
        hardware: noise, resolution and delay.
        seed: seed of the starts and the noise.

    Raises:
        InputError: MuJoCo is missing or refuses the model; a joint is not a hinge or slide, or not in the file; the
            file has an element that is refused above, or non-finite numbers; a motor has no limits; there is no motor
            or no passive joint, or gravity does not move a passive joint; bodies touch at the goal or hanging; a sample
            is not a whole number of steps.
    """
    mujoco, model, speeds, transmissions = _model(source)
    names = joint_names(model)
    for name, kind in zip(names, model.jnt_type, strict=True):
        if kind in (int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)):
            raise InputError(f"joint '{name}' is neither a hinge nor a slide; expected only hinges and slides")
    if not 1 + passive <= len(names) <= MOST_JOINTS:
        which = f"2 to {MOST_JOINTS}, one of them passive" if passive else f"1 to {MOST_JOINTS}"
        raise InputError(f"the plant has {len(names)} joint(s); expected {which}")
    rate, steps = _sampling(model, rate)
    robot = robot_of(model, {})
    _require_known_forces(mujoco, model)
    joints, ranges = robot.tree.joints, robot.position_limits
    controls, largest = _motors(model, robot)
    stated = actuated if len(actuated) else [name for name in transmissions if name in names]
    driven = _numbers(stated, names) if len(stated) else np.flatnonzero(controls.any(axis=0)).tolist()
    if not driven:
        raise InputError(
            "no joint has a motor: the file has no actuator (in a URDF, no transmission); name the joints with one "
            "(--actuated)"
        )
    data = mujoco.MjData(model)

    def potential(q: np.ndarray) -> float:
        data.qpos[:] = q
        with quiet(mujoco):
            mujoco.mj_fwdPosition(model, data)
        mujoco.mj_energyPos(model, data)
        return float(data.energy[0])

    if goal is None or hanging is None:
        lowest, highest = extremes(potential, joints, driven, ranges)
        goal = highest if goal is None else goal
        if hanging is None:
            hanging = lowest
            for k in sorted(set(range(len(joints))) - set(driven)) if passive else ():
                if hanging[k] in ranges[k]:
                    raise InputError(
                        f"'{names[k]}' cannot hang within its range of {ranges[k, 0]:.4g} to {ranges[k, 1]:.4g}, and "
                        "a swing-up starts there; widen or remove the range"
                    )
    if control is None and not (passive and len(driven) == len(joints)):  # the layout refuses these
        for k in driven:
            if not 0 < largest[k] < np.inf:
                raise InputError(
                    f"the file has no limit for the motor of joint '{names[k]}'; give the largest force (--control), "
                    "or an actuatorfrcrange"
                )
        control = largest[driven]
    known = layout(
        joints, driven, goal=goal, hanging=hanging, rate=rate, control=control, position=ranges,
        speed=[speeds.get(name, np.inf) for name in names] if speed is None else speed, names=names, passive=passive,
    )  # fmt: skip
    for k, asked in zip(driven, known.limits.control[:, 1], strict=True):
        if asked > largest[k]:
            raise InputError(
                f"control is {asked:g}; the file limits the motor of joint '{names[k]}' to {largest[k]:g} N m or N"
            )
    for where, q in (("at the goal", known.goal), ("where the plant hangs", known.hanging)):
        potential(q)
        for pair in data.contact.geom[data.contact.dist < 0][:1]:
            first, second = (model.body(body).name or body for body in model.geom_bodyid[pair])
            raise InputError(
                f"bodies '{first}' and '{second}' touch {where}; exclude their contact, or move them apart"
            )
    B = known.actuation
    applied = np.where(controls.any(axis=0)[:, None], 0.0, B)

    def begin(q: np.ndarray) -> None:
        mujoco.mj_resetData(model, data)
        data.qpos[:] = q

    def act(u: np.ndarray) -> None:
        data.ctrl[:] = controls @ B @ u
        data.qfrc_applied[:] = applied @ u
        _advance(mujoco, model, data, steps)

    def kick(rates: np.ndarray) -> None:
        data.qvel[:] += rates

    return simulated(known, begin, lambda: data.qpos, act, kick=kick, hardware=hardware, seed=seed)


def simulate_in_mujoco(
    model: Any,
    controller: Controller,
    x: Any,
    *,
    seconds: float,
    rate: float,
    actuation: Any = None,
    hardware: Hardware = Hardware(),  # noqa: B008
    key: Array | None = None,
) -> ClosedLoopRun:
    """Runs `simulate` with MuJoCo, which is independent of the equations in this library.

    After a non-finite control, or if MuJoCo warns of divergence, everything is NaN. The plant is any model of hinges
    and slides. The simulation is not differentiable.

    Args:
        model: the text of an MJCF file, for example of a tree from `data.robot_files.mjcf`, or a `mujoco.MjModel`.
        controller: called once per sample.
        x: initial (q, qd) [2 d], in MuJoCo's order of joints.
        seconds: duration of the run.
        rate: sampling rate, Hz; a sample is a whole number of MuJoCo's time steps.
        actuation: matrix [actuators, m] in ctrl = actuation u; by default u is ctrl.
        hardware: limits, noise, delay; the model's own limits also apply.
        key: random key of the noise; required with noise.

    Raises:
        InputError: MuJoCo is missing or refuses the model; a joint is neither a hinge nor a slide; x has another size;
            the time step is not positive and finite; a sample is not a whole number of steps; or as for `simulate`.
    """
    require_positive(seconds=seconds, rate=rate)
    mujoco, model = compiled_model(model)
    if model.nq != model.nv or np.shape(x) != (2 * model.nv,):
        raise InputError(
            f"x has shape {np.shape(x)} for {model.nv} degrees of freedom; expected hinges, slides and [2 d]"
        )
    _, steps = _sampling(model, rate)
    B = np.eye(model.nu) if actuation is None else np.asarray(actuation, float)
    data, last = mujoco.MjData(model), [np.zeros(0)]

    def advanced(x: Any, u: Any) -> np.ndarray:
        x, control = np.asarray(x), B @ np.asarray(u)
        # MuJoCo continues from its own state, which also holds the start of its solver. Another x begins anew.
        if not np.array_equal(x, last[0]):
            mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:] = np.split(x, 2)
        # MuJoCo replaces non-finite values, and resets after divergence: both would hide a failure.
        finite = np.isfinite(control).all() and np.isfinite(x).all()
        if finite:
            data.ctrl[:] = control
            _advance(mujoco, model, data, steps)
        after = np.concatenate([data.qpos, data.qvel])
        last[0] = np.where(finite and np.isfinite(after).all(), after, np.nan).astype(x.dtype)
        return last[0]

    def step(x: Array, u: Array) -> Array:
        return jax.pure_callback(advanced, jax.ShapeDtypeStruct(x.shape, x.dtype), x, u, vmap_method="sequential")

    return simulate(
        step, controller, x, seconds=seconds, rate=rate, controls=B.shape[1], hardware=hardware, key=key, substeps=None
    )


def _advance(mujoco: Any, model: Any, data: Any, steps: int) -> None:
    """Advances MuJoCo's data by some time steps; the positions become NaN if it diverges."""
    with quiet(mujoco):
        mujoco.mj_step(model, data, steps)
    bad = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
    if any(data.warning[kind].number for kind in bad):
        data.qpos[:] = np.nan


def _sampling(model: Any, rate: float | None = None) -> tuple[float, int]:
    """Returns the rate of the samples, Hz, by default one per time step, and the number of time steps in a sample.

    Raises:
        InputError: the time step is not positive and finite, or a sample is not a whole number of steps.
    """
    step = float(model.opt.timestep)
    if not 0 < step < np.inf:
        raise InputError(f"the time step of the model is {step:g} s; expected a positive, finite number")
    rate = float(1 / step if rate is None else rate)
    steps = 1 / rate / step
    if not 0.5 < steps < np.inf or abs(steps - round(steps)) > 1e-6:
        raise InputError(f"a sample has {steps:.4g} steps of {step:g} s; expected a whole number")
    return rate, round(steps)


def _require_known_forces(mujoco: Any, model: Any) -> None:
    """Raises `InputError` for forces other than motors and the gravity of a chain, and for disabled motors."""
    off = model.opt.disableactuator or model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    for what, present in {
        "disabled actuators": off and model.nu,
        "gravity compensation": model.body_gravcomp.any(),
        "wind": model.opt.wind.any(),
        "plugins": model.nplugin,
    }.items():
        if present:
            raise InputError(f"the file has {what}; expected a chain moved only by motors and gravity")


def _model(source: Any) -> tuple[Any, Any, dict[str, float], list[str]]:
    """Returns MuJoCo, its model, and two facts from a URDF: largest rates by joint, and joints with a transmission."""
    if isinstance(source, Path) or (isinstance(source, str) and not source.lstrip().startswith("<")):
        root = parse_robot(Path(source))
        mujoco, model = compile_robot(Path(source), root, (), inertias=True)[:2]
        if root.tag != "robot":
            return mujoco, model, {}, []
        # A URDF states no integrator, and MuJoCo's default adds errors beyond rigid-body motion.
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


def _motors(model: Any, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
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
                        f"actuator '{name}' has limits {low:g} to {high:g}; expected finite limits around zero"
                    )
                largest[joint] = min(largest[joint], scale * min(-low, high))
    return controls, largest
