"""A command that works on several devices, and in several processes."""

from jax.sharding import Mesh

from dln_jax.command_line.options import Scaled
from dln_jax.scale.mesh import batch_mesh


def mesh_of(given: Scaled) -> Mesh | None:
    """The devices that share a command's batches, `None` where that is one alone.

    Raises:
        InputError: there are not so many.
    """
    return batch_mesh(given.devices)
