"""Contact between and within bodies: barriers, their pairs, and steps that never cross."""

from dln_jax.softbody.contact.bodies import BodyContact, ContactParameters, body_contact
from dln_jax.softbody.contact.crossings import crossings

__all__ = ["BodyContact", "ContactParameters", "body_contact", "crossings"]
