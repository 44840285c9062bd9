"""A rotary pendulum in a process of its own, in real time: `python -m scripts.reports.control.rig SEED`.

It prints its port and serves one connection: it answers "q" by the angles of arm and pole, rad, wrapped and with noise,
and takes "u TORQUE", N m. It shares no code with this library, and its motor follows 10 ms late.
"""

import math
import random
import socket
import sys
import time
from collections import deque

STEP, LATE, NOISE, LARGEST = 5e-4, 0.010, 1e-3, 0.05
"""Time step and delay of the motor, s; noise of the angles, rad; largest torque, N m."""
ARM, SINE, COUPLING, POLE, WEIGHT = 2.6e-4, 1e-4, 1.3e-4, 1.33e-4, 1.52e-2
"""Inertias, kg m², and weight of the pole, N m."""
DRY, SLIDING, BEARING, HINGE = 1e-3, 0.02, 1e-4, 8e-5
"""Dry friction of the arm, N m, the rate at which it is complete, rad/s, and viscous friction, N m s."""


def accelerations(q: list[float], v: list[float], torque: float) -> tuple[float, float]:
    """Returns the accelerations of arm and pole, by Cramer's rule."""
    sine, cosine = math.sin(q[1]), math.cos(q[1])
    a, b, c = ARM + SINE * sine**2, COUPLING * cosine, POLE
    friction = BEARING * v[0] + DRY * math.tanh(v[0] / SLIDING)
    first = torque - 2 * SINE * sine * cosine * v[0] * v[1] + COUPLING * sine * v[1] ** 2 - friction
    second = SINE * sine * cosine * v[0] ** 2 + WEIGHT * sine - HINGE * v[1]
    determinant = a * c - b * b
    return (c * first - b * second) / determinant, (a * second - b * first) / determinant


class Pendulum:
    """A rotary pendulum that hangs near rest at first."""

    def __init__(self, noise: random.Random, start: float = 0.0) -> None:
        self.noise, self.torque, self.simulated = noise, 0.0, start
        self.q, self.v = [noise.gauss(0, 0.05), math.pi + noise.gauss(0, 0.05)], [0.0, 0.0]
        self.commands: deque[tuple[float, float]] = deque()

    def seen(self, now: float) -> list[float]:
        """Measured angles at a time."""
        while self.simulated + STEP <= now:
            while self.commands and self.commands[0][0] + LATE <= self.simulated:
                self.torque = self.commands.popleft()[1]
            rates = accelerations(self.q, self.v, self.torque)
            self.v = [rate + STEP * change for rate, change in zip(self.v, rates, strict=True)]
            self.q = [angle + STEP * rate for angle, rate in zip(self.q, self.v, strict=True)]
            self.simulated += STEP
        return [math.remainder(angle + NOISE * self.noise.gauss(), 2 * math.pi) for angle in self.q]

    def command(self, now: float, torque: float) -> None:
        """Sends a torque, which follows late."""
        self.commands.append((now, max(-LARGEST, min(LARGEST, torque))))


def main() -> None:
    """Serves one connection until it closes."""
    plant = Pendulum(random.Random(int(sys.argv[1])))
    server = socket.create_server(("127.0.0.1", 0))
    print(server.getsockname()[1], flush=True)
    connection, _ = server.accept()
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    lines = connection.makefile("rw")
    start = time.monotonic()
    for line in lines:
        if line[0] == "u":
            plant.command(time.monotonic() - start, float(line[1:]))
        else:
            print(*plant.seen(time.monotonic() - start), file=lines, flush=True)


if __name__ == "__main__":
    main()
