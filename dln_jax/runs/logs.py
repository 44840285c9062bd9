"""Keywords of `data.log.read_log` from options of a command."""

from typing import Any

from dln_jax.data.stated_needs import needs_from_text
from dln_jax.runs.arguments import names_listed, numbers_of, pairs_of
from dln_jax.runs.options import Checked, Filtered, Logged
from dln_jax.types import InputError, Needs


def facts(options: Logged) -> dict[str, Any]:
    """Facts on a file, and how to filter and check it, as far as a command has options for them."""
    names = {"joints": names_listed(options.joints), "topics": names_listed(options.topics)}
    factor = None if options.torque_factor is None else torque_factor(options.torque_factor)
    stated = {"rate": options.rate, "units": options.units, "torque_factor": factor, **names}
    if isinstance(options, Checked):
        stated["accept_log"] = options.accept_log
    if isinstance(options, Filtered):
        stated["cutoff"] = cutoff(options.cutoff)
    return stated


def torque_factor(text: str) -> float | tuple[float, ...] | dict[str, float]:
    """Parses --torque-factor: a number, one for each joint, or NAME=NUMBER."""
    option = "--torque-factor"
    if "=" in text:
        pairs = pairs_of(option, text.split(","))
        return {name: numbers_of(f"{option} {name}", factor, [1])[0] for name, factor in pairs.items()}
    numbers = numbers_of(option, text)
    return numbers[0] if len(numbers) == 1 else numbers


def cutoff(text: str | None) -> Any:
    """Parses --cutoff: Hz, auto, or inf."""
    if text in (None, "auto"):
        return text
    try:
        value = float(str(text))
    except ValueError:
        value = -1.0
    if not value > 0:
        raise InputError(f"--cutoff is {text!r:.40}; expected Hz, a positive number, or auto (inf: no filter)")
    return value


def needs_of(text: str | None) -> Needs | None:
    """Parses --needs; `InputError` if the text does not state valid needs."""
    try:
        return None if text is None else needs_from_text(text)
    except InputError as error:
        raise InputError(f"--{error}; see --help for an example") from None
