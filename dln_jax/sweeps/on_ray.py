"""Jobs as tasks of Ray: on its cluster, or on this machine."""

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from dln_jax.sweeps.engines import Engine, required
from dln_jax.sweeps.work import perform

THREADS = {"OPENBLAS_NUM_THREADS": "1", "NPROC": "1"}
"""Of BLAS and of XLA, in each job: it asks for one core."""


def work(path: str) -> None:
    """Does the job of a file."""
    perform(Path(path))


@contextlib.contextmanager
def ray(at_once: int, gpus: int) -> Iterator[Engine]:
    """Yields the engine: the cluster that Ray finds (RAY_ADDRESS, or one started on this machine), else one of its own.

    Each job is a task of one core, and of one accelerator if `gpus` is not 0, in a process of its own, which Ray does
    not try again: what --resume does is known here. All hosts must see the folder of the sweep.
    """
    engine = required("ray", "ray")
    if os.environ.get("RAY_ADDRESS"):
        engine.init(log_to_driver=False)
    else:
        own = {"num_cpus": at_once, "num_gpus": gpus, "include_dashboard": False}
        engine.init(address="local", log_to_driver=False, logging_level="ERROR", **own)
    task = engine.remote(num_cpus=1, num_gpus=min(gpus, 1), max_retries=0, max_calls=1)(work)
    task = task.options(runtime_env={"env_vars": THREADS})

    def start(paths: Sequence[Path]) -> list[Any]:
        return [task.remote(str(path)) for path in paths]

    def over(handle: Any) -> str | None:
        if not engine.wait([handle], timeout=0)[0]:
            return None
        try:
            engine.get(handle)
        except engine.exceptions.RayError as error:
            return str(error).strip().partition("\n")[0][:200]
        return ""

    def stop(handles: Sequence[Any]) -> None:
        for handle in handles:
            engine.cancel(handle, force=True)

    try:
        yield Engine(start, over, stop, at_once)
    finally:
        engine.shutdown()
