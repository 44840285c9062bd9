"""A model of the speed-up by n hosts: measured computing time against bytes and messages of a network.

    T(n) = C / n + B(n) 8 / rate + M(n) latency
    all-gather of G bytes:   B = (n - 1) / n G,     M = n - 1
    sum of S bytes:          B = 2 (n - 1) / n S,   M = 2 (n - 1)        (each of them)

in rings, which move the minimum number of bytes (Patarasuk and Yuan 2009, "Bandwidth optimal all-reduce algorithms for
clusters of workstations"). C is the time of one device. The model neglects work that all hosts repeat, such as solving
the normal equations, and the shorter waits of lanes in smaller groups.
"""

from collections.abc import Sequence
from typing import NamedTuple

from scripts.reports.rows import Row

CASES = "hosts/"
"""Prefix of the cases of modelled rows."""

HOSTS = (1, 2, 4, 8, 16, 64)
NUMBER = 8
"""Bytes of a float64."""


class Network(NamedTuple):
    """An assumed network between hosts."""

    rate: float
    """Bandwidth, bit/s."""
    latency: float = 5e-5
    """Latency of a message, s: TCP in a local network."""


NETWORKS = {"1_gbit": Network(1e9), "25_gbit": Network(25e9)}


class Exchange(NamedTuple):
    """Communication of a step."""

    gathered: float = 0.0
    """Bytes of all results, gathered on all hosts."""
    summed: float = 0.0
    """Bytes of the sums, which all hosts receive."""
    sums: int = 0
    """Number of successive sums."""


def of_results(lanes: int, size: int = 1) -> Exchange:
    """Gathers `size` numbers per lane: the fitness of an episode, or a gradient."""
    return Exchange(gathered=NUMBER * lanes * size)


def of_gradient(parameters: int) -> Exchange:
    """A step of Adam: one sum of the gradient."""
    return Exchange(summed=NUMBER * parameters, sums=1)


def of_normal_equations(parameters: int) -> Exchange:
    """An iteration of Gauss-Newton with one trial: half of JᵀJ, and three sums of a gradient at most."""
    return Exchange(summed=NUMBER * (parameters**2 / 2 + 3 * parameters), sums=4)


def exchange_seconds(exchange: Exchange, hosts: int, network: Network) -> float:
    """Time that a step waits for the network, s."""
    share = (hosts - 1) / hosts
    sent = share * (exchange.gathered + 2 * exchange.summed)
    messages = (hosts - 1) * ((exchange.gathered > 0) + 2 * exchange.sums)
    return 8 * sent / network.rate + messages * network.latency


def speed_up(seconds: float, exchange: Exchange, hosts: int, network: Network) -> float:
    """Speed-up of n hosts over one host, which takes `seconds`."""
    return seconds / (seconds / hosts + exchange_seconds(exchange, hosts, network))


def rows(work: str, seconds: float, exchange: Exchange) -> list[Row]:
    """The speed-up of a step on each number of hosts, as cases hosts/WORK/NETWORK."""
    case = f"{CASES}{work}"
    moved = Row(case, "megabytes_per_step", (exchange.gathered + exchange.summed) / 1e6, "MB")
    return [Row(case, "seconds_per_step_of_one", seconds, "s"), moved] + [
        Row(f"{case}/{name}", f"speed_up_of_{hosts}", speed_up(seconds, exchange, hosts, network))
        for name, network in NETWORKS.items()
        for hosts in HOSTS
    ]


def curves(modelled: Sequence[Row]) -> dict[str, list[float]]:
    """Speed-ups by network, from the rows of one work."""
    return {name: [row.value for row in modelled if row.case.endswith(f"/{name}")] for name in NETWORKS}
