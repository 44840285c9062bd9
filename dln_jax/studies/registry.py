"""The cases of all studies: what the reports measure, by study, with the options that each takes."""

from collections.abc import Callable

from dln_jax.studies import soft_bodies, stability
from dln_jax.studies.arm import table as arm
from dln_jax.studies.case import Case
from dln_jax.studies.differential_networks import one_pass
from dln_jax.studies.differential_networks import table as differential_networks
from dln_jax.studies.hamiltonian import table as hamiltonian
from dln_jax.studies.speed import derivatives, subjects
from dln_jax.studies.stability import interruptions

__all__ = ["STUDIES"]

STUDIES: dict[str, Callable[..., list[Case]]] = {
    "arm": arm.cases,
    "differential-networks": differential_networks.cases,
    "differential-networks-pass": one_pass.cases,
    "hamiltonian": hamiltonian.cases,
    "interruptions": interruptions.cases,
    "natural-derivatives": derivatives.cases,
    "soft-bodies": soft_bodies.cases,
    "speed": subjects.cases,
    "stability": stability.cases,
}
"""Without options, the whole study as its report has it."""
