"""One process of a measurement of scale: `python -m scripts.reports.scale.worker LAYOUT PROCESS PORT`.

Reads lines of JSON from standard input: {"work": NAME, ...} compiles the work, and is answered by facts about it; null
does it once, and is answered by seconds. The process ends with its input, or if an answer takes too long.
"""

import faulthandler
import json
import os
import sys
import time

import jax

from dln_jax.scale.mesh import batch_mesh
from scripts.reports.scale.work import WORK

LIMIT = 600.0
"""Time limit of an answer, s; then the process ends."""


def main(devices: int, processes: int, process: int, port: int) -> None:
    """Answers until there are no more questions."""
    # Output of libraries goes to standard error; standard output carries only answers.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    jax.config.update("jax_enable_x64", True)
    if os.environ.get("JAX_PLATFORMS") == "cpu":
        jax.config.update("jax_num_cpu_devices", devices)
    if processes > 1:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(f"127.0.0.1:{port}", processes, process)

    def answer(**values: float | str) -> None:
        print(json.dumps(values), file=answers, flush=True)

    answer(platform=jax.default_backend(), kind=jax.devices()[0].device_kind, devices=jax.local_device_count())
    work = None
    for line in sys.stdin:
        faulthandler.dump_traceback_later(LIMIT, exit=True)
        question = json.loads(line)
        if question is not None:
            work = WORK[question.pop("work")](batch_mesh(devices), **question)
            answer(**work.facts)
        elif work is not None:
            start = jax.block_until_ready(work.fresh())
            wall, processor = time.perf_counter(), time.process_time()
            jax.block_until_ready(work.run(start))
            answer(seconds=time.perf_counter() - wall, processor_seconds=time.process_time() - processor)
        faulthandler.cancel_dump_traceback_later()


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
