"""Modules of rivals that a report may need and an installation may lack."""

from typing import Any

from dln_jax.types import InputError


def casadi() -> Any:
    """The module of CasADi; `InputError` if it is not installed."""
    try:
        import casadi as ca
    except ImportError as error:
        raise InputError("this measurement needs CasADi: pip install casadi") from error
    return ca
