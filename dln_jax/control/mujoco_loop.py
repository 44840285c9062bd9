"""Closed loop with a plant simulated by MuJoCo, which shares no equations with this library (extra `[robot]`)."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control.closed_loop import ClosedLoopRun, Controller, Hardware, sampled
from dln_jax.data.robots import compiled_model, quiet
from dln_jax.types import InputError, require_positive


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
    """Simulates one run as `simulate` does, sample by sample, with MuJoCo's integrator and time step.

    After a control that is not finite, or if MuJoCo warns of divergence, everything is NaN.

    Args:
        model: the text of an MJCF file, for example of a tree from `data.robot_files.mjcf`, or a `mujoco.MjModel`.
        controller: called once per sample.
        x: initial (q, qd) [2 d], in MuJoCo's order of joints.
        seconds: duration of the run.
        rate: sampling rate, Hz; a sample is a whole number of MuJoCo's time steps.
        actuation: matrix [actuators, m] in ctrl = actuation u; by default u is ctrl.
        hardware: limits, noise, delay; the model's own limits also apply.
        key: random key of the noise; required if there is any.

    Raises:
        InputError: MuJoCo is missing or refuses the model; a joint is neither a hinge nor a slide; x has another size;
            the time step is not positive and finite; a sample is not a whole number of steps; or as for `simulate`.
    """
    require_positive(seconds=seconds, rate=rate)
    mujoco, model = compiled_model(model)
    data, x = mujoco.MjData(model), np.asarray(x, float)
    if model.nq != model.nv or x.shape != (2 * model.nv,):
        raise InputError(f"x has shape {x.shape} for {model.nv} degrees of freedom; expected hinges, slides and [2 d]")
    _, steps = sampling(model, rate)
    B = np.eye(model.nu) if actuation is None else np.asarray(actuation, float)
    data.qpos[:], data.qvel[:] = np.split(x, 2)
    memory, act = sampled(controller, hardware, controls=B.shape[1], rate=rate, key=key)
    act = jax.jit(act)
    states, controls, measurements = [x], [], []
    for number in range(round(seconds * rate)):
        memory, u, y = act(memory, jnp.asarray(states[-1]), jnp.asarray(number))
        controls.append(u)
        measurements.append(y)
        states.append(_advanced(mujoco, model, data, B @ np.asarray(u), steps))
    t = jnp.arange(len(states)) / rate
    return ClosedLoopRun(t, jnp.asarray(np.stack(states)), jnp.stack(controls), jnp.stack(measurements))


def _advanced(mujoco: Any, model: Any, data: Any, control: np.ndarray, steps: int) -> np.ndarray:
    """Returns the state after a sample, or NaN after a failure."""
    # MuJoCo replaces values that are not finite, and resets when it diverges: both would hide a failure.
    if np.isfinite(control).all() and np.isfinite(data.qpos).all():
        data.ctrl[:] = control
        advance(mujoco, model, data, steps)
    else:
        data.qpos[:] = np.nan
    x = np.concatenate([data.qpos, data.qvel])
    return x if np.isfinite(x).all() else np.full_like(x, np.nan)


def advance(mujoco: Any, model: Any, data: Any, steps: int) -> None:
    """Advances MuJoCo's data by some time steps; the positions become NaN if it diverges."""
    with quiet(mujoco):
        mujoco.mj_step(model, data, steps)
    bad = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
    if any(data.warning[kind].number for kind in bad):
        data.qpos[:] = np.nan


def sampling(model: Any, rate: float | None = None) -> tuple[float, int]:
    """Returns the rate of the samples, Hz, by default one per time step, and the number of time steps in a sample.

    Raises:
        InputError: the time step is not positive and finite, or a sample is not a whole number of steps.
    """
    step = float(model.opt.timestep)
    if not 0 < step < np.inf:
        raise InputError(f"the time step of the model is {step:g} s; expected a positive, finite one")
    rate = float(1 / step if rate is None else rate)
    steps = 1 / rate / step
    if not 0.5 < steps < np.inf or abs(steps - round(steps)) > 1e-6:
        raise InputError(f"a sample has {steps:.4g} steps of {step:g} s; expected a whole number")
    return rate, round(steps)
