"""Count the files that a reader follows from an npz to the torque error, and from a URDF and a log to parameters.

Runs train_delan and identify on small files, without figures, timings and uncertainty. Counts the files of the library
that are entered, and the pairs of calling and called file. Prints both with their bounds, and writes walks.json.
"""

import contextlib
import importlib
import io
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dln_jax.cli.arguments import arguments_of
from dln_jax.cli.commands import identify, train_delan
from dln_jax.cli.options import Folder
from dln_jax.cli.stored_arguments import command_folder
from dln_jax.data import schema
from dln_jax.files import write_json
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.poles import cart_pole
from scripts.reports.walks import Walk, walk_of

BOUNDS = {"npz to torque error": (30, 60), "URDF and log to parameters": (40, None)}
"""Largest numbers of files and arrows."""
PENDULUM = """<robot name="pendulum"><link name="base"/><link name="rod"><inertial><origin xyz="0 0 -0.5"/>
<mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hinge" type="revolute"><parent link="base"/><child link="rod"/>
<axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="9" velocity="9"/></joint>
</robot>"""


@dataclass(frozen=True)
class Arguments(Folder):
    """Where the report goes."""

    files: bool = False
    """Also print the files of each walk, in the order of entering them."""


def main(options: Arguments) -> None:
    """Traces both commands, prints the counts and writes them."""
    with command_folder(options, "walk_report") as folder:
        walks = measured()
        for name, walk in walks.items():
            files, arrows = BOUNDS[name]
            bound = "" if arrows is None else f" (to reach {arrows})"
            print(f"{name}: {len(walk.files)} files (to reach {files}), {len(walk.arrows)} arrows{bound}")
            if options.files:
                print("\n".join(f"  {file}" for file in walk.files))
        write_json(folder / "walks.json", {name: walk._asdict() for name, walk in walks.items()})
        print(f"run folder: {folder}")


LIBRARY = (
    *("dln_jax.public", "dln_jax.cli.compilation_cache", "dln_jax.training.dynamics.methods.network"),
    *("dln_jax.training.dynamics.run", "dln_jax.training.identification.run"),
)
"""Modules of the library that commands import when they run; imports are not part of a walk."""


def measured() -> dict[str, Walk]:
    """The walks of both commands on small generated files."""
    for name in LIBRARY:
        importlib.import_module(name)
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        schema.save(place / "log.npz", generators.uniform(cart_pole(friction=0.1), samples=60))
        t = np.arange(0, 6, 0.01)
        q = np.stack([np.sin(t) + 0.3 * np.sin(3.1 * t), np.cos(1.3 * t) - 0.4 * np.sin(2.3 * t)])
        qd = np.gradient(q, 0.01, axis=1)
        qdd = np.gradient(qd, 0.01, axis=1)
        tau = 0.35 * qdd + 4.9 * np.sin(q) + 0.1 * qd
        columns = {"q": q, "qd": qd, "qdd": qdd, "tau": tau}
        swings = {name: values.reshape(-1, 1) for name, values in columns.items()}
        trajectory = np.repeat([0, 1], len(t))
        np.savez(place / "swings.npz", t=np.tile(t, 2), trajectory=trajectory, **swings)  # type: ignore[arg-type]
        (place / "robot.urdf").write_text(PENDULUM)
        train = arguments_of(
            train_delan.Arguments,
            data=place / "log.npz",
            model="structured-delan",
            steps=3,
            uncertainty=False,
            low_latency=False,
            figures=False,
            out=place / "run",
        )
        parameters = identify.Arguments(
            data=place / "swings.npz", robot=place / "robot.urdf", out=place / "tree", figures=False
        )
        with contextlib.redirect_stdout(io.StringIO()):
            return {
                "npz to torque error": walk_of(lambda: train_delan.main(train)),
                "URDF and log to parameters": walk_of(lambda: identify.main(parameters)),
            }
