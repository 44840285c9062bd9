"""Barrier contact between and within bodies and with rigid obstacles: surfaces never cross."""

from dln_jax.softbody.contact.bodies import body_contact
from dln_jax.softbody.contact.contact import Contact, ContactParameters
from dln_jax.softbody.contact.crossings import crossings
from dln_jax.softbody.contact.obstacles import (
    Obstacle,
    box,
    capsule,
    half_space,
    heightfield,
    obstacle_contact,
    sphere,
)

__all__ = [
    "Contact",
    "ContactParameters",
    "Obstacle",
    "body_contact",
    "box",
    "capsule",
    "crossings",
    "half_space",
    "heightfield",
    "obstacle_contact",
    "sphere",
]
