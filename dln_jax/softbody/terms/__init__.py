"""Energy terms of soft bodies, with their material and friction laws."""

from dln_jax.softbody.terms.contact import distance_contact, plane_contact
from dln_jax.softbody.terms.creature import creature_terms
from dln_jax.softbody.terms.damping import mass_damping, stiffness_damping
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.fibres import fibres
from dln_jax.softbody.terms.gravity import gravity
from dln_jax.softbody.terms.loads import body_force, point_force, traction
from dln_jax.softbody.terms.penalty import damping_of_restitution
from dln_jax.softbody.terms.pressure import gas, pressure
from dln_jax.softbody.terms.springs import muscles, springs
from dln_jax.softbody.terms.strain_energies import corotated, neo_hookean, st_venant_kirchhoff, stable_neo_hookean
from dln_jax.softbody.terms.tendons import path_length, tendon_of_length, tendon_of_tension
from dln_jax.softbody.terms.term import Context, Term

__all__ = [
    "Context",
    "Term",
    "body_force",
    "corotated",
    "creature_terms",
    "damping_of_restitution",
    "distance_contact",
    "elastic",
    "fibres",
    "gas",
    "gravity",
    "mass_damping",
    "muscles",
    "neo_hookean",
    "path_length",
    "plane_contact",
    "point_force",
    "pressure",
    "springs",
    "st_venant_kirchhoff",
    "stable_neo_hookean",
    "stiffness_damping",
    "tendon_of_length",
    "tendon_of_tension",
    "traction",
]
