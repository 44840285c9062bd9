"""The textbook scenes by name."""

from collections.abc import Callable

from dln_jax.scenes.particles import henon_heiles, mass_spring, n_body
from dln_jax.scenes.pendulums import (
    cart_pole,
    chain,
    double_pendulum,
    flexible_cart_pole,
    pendulum,
    rotary_pendulum,
    two_link_arm,
    two_link_pendulum,
)
from dln_jax.scenes.scene import Scene
from dln_jax.types import InputError

SCENES: dict[str, Callable[[], Scene]] = {
    "two-link-arm": two_link_arm,
    "two-link-arm-hanging": lambda: two_link_arm(zero="hanging"),
    "pendulum": pendulum,
    "double-pendulum": double_pendulum,
    "cart-pole": cart_pole,
    "flexible-cart-pole": flexible_cart_pole,
    "rotary-pendulum": rotary_pendulum,
    "acrobot": lambda: two_link_pendulum("elbow"),
    "pendubot": lambda: two_link_pendulum("shoulder"),
    "mass-spring": mass_spring,
    "henon-heiles": henon_heiles,
    "two-body": lambda: n_body(2),
    "three-body": lambda: n_body(3),
    **{f"chain-{d}": (lambda d=d: chain(d)) for d in range(1, 13)},
}


def scene_named(name: str) -> Scene:
    """Returns the scene with this name; `InputError` lists the names if it is unknown."""
    if name not in SCENES:
        raise InputError(f"scene '{name}' is unknown; choose from {', '.join(SCENES)}")
    return SCENES[name]()
