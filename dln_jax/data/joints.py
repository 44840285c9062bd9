"""Matches the joints of a dataset with those of a robot, by name if the data have names."""

import reprlib
from collections.abc import Sequence

from dln_jax.data.schema import OPTIONAL, RATES, Trajectories
from dln_jax.types import InputError


def with_joints(data: Trajectories, names: Sequence[str]) -> Trajectories:
    """Reorders the columns of the data to these joints; data without joint names stay unchanged.

    Raises:
        InputError: the number of joints differs, or the names do.
    """
    d = data.degrees_of_freedom
    if len(names) != d:
        raise InputError(f"the data have {d} joints, the robot {len(names)}: {reprlib.repr(', '.join(names))}")
    if data.joint_names is None:
        return data
    own = data.joint_names.tolist()
    if missing := [name for name in names if name not in own]:
        shown = ", ".join(own)
        raise InputError(f"the robot's joint '{missing[0]}' is not among the data's ({shown:.300}); make names agree")
    order = [own.index(name) for name in names]
    columns = {key: getattr(data, key)[:, order] for key in ("q", *RATES, *OPTIONAL) if getattr(data, key) is not None}
    needs = None if data.needs is None else data.needs._replace(joints=tuple(data.needs.joints[k] for k in order))
    return data._replace(**columns, joint_names=data.joint_names[order], needs=needs)
