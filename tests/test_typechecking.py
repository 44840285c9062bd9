"""A function within another is checked whenever it is defined, by checks that are made once."""

import numpy as np
import pytest
from jaxtyping import Float, TypeCheckError, jaxtyped
from typechecking import checked


def defined():
    @jaxtyped(typechecker=checked)
    def first(x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"], *, swap: bool = False) -> Float[np.ndarray, " n"]:
        return x[:1] if swap else x + y

    class Own:
        pass

    @jaxtyped(typechecker=checked)
    def second(own: Own) -> Own:
        return own

    return first, second, Own


def test_shapes_are_checked_at_every_definition():
    for _ in range(2):
        function, *_ = defined()
        assert function(np.ones(2), np.ones(2)).shape == (2,)
        for given, keywords in (((2, 3), {}), ((2, 2), {"swap": True}), ((2, 2), {"swap": 1})):
            with pytest.raises(TypeCheckError):
                function(*map(np.ones, given), **keywords)


def test_classes_of_one_name_are_not_mistaken_for_each_other():
    (_, one, Own), (_, other, Other) = defined(), defined()
    assert isinstance(one(Own()), Own) and isinstance(other(Other()), Other)
    with pytest.raises(TypeCheckError):
        other(Own())
