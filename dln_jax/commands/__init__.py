"""The commands, one file each: python -m dln_jax NAME."""

import pkgutil

__all__ = ["command_names"]


def command_names() -> list[str]:
    """Names of all commands, sorted."""
    return sorted(module.name for module in pkgutil.iter_modules(__path__))
