"""Every model that a command names has a method of fitting."""

import re

from dln_jax.cli.commands import train_delan, train_hnn
from dln_jax.training.dynamics.options import AUTO, FITS
from dln_jax.zoo.catalogue import CATALOGUE


def test_every_model_of_a_command_has_a_method():
    assert set(FITS) - {AUTO} <= set(CATALOGUE)
    for command in (train_delan, train_hnn):
        names = re.findall(r"'([\w-]+)'", repr(command.Arguments.__annotations__["model"]))
        assert names and set(names) <= set(FITS)
