"""Adds realistic joint friction to any scene: viscous, dry, and Stribeck friction near rest."""

from dln_jax.mechanics.friction import FrictionCoefficients, FrictionShape, joint_dissipation
from dln_jax.scenes.scene import Scene
from dln_jax.types import Dissipation, FrictionLaw, InputError, Scalar, Vector

LAWS: tuple[FrictionLaw, ...] = ("viscous", "coulomb", "stribeck")
"""Friction laws available for a scene; the others of `mechanics.friction.laws` apply to gears."""


def with_friction(
    scene: Scene,
    coefficients: FrictionCoefficients,
    shape: FrictionShape = FrictionShape(),  # noqa: B008
) -> Scene:
    """Adds friction to the joints of a scene, in addition to any it already has.

    Dry friction is c tanh(u / v) with a small v, `shape.velocity_scale`: a joint "at rest" creeps more slowly than v.
    An explicit integrator is stable for steps below some 2.8 m v / c, where m is the smallest inertia at the joint.

    Args:
        scene: a scene with any joints.
        coefficients: viscous, coulomb and stribeck, one number per joint or one for all.
        shape: velocity scale and Stribeck velocity.

    Raises:
        InputError: no coefficient, one of another law, or a negative one.
    """
    given = {name: value for name, value in coefficients._asdict().items() if value is not None}
    if others := [name for name in given if name not in LAWS]:
        raise InputError(f"a scene has no {others[0]} friction; expected some of {', '.join(LAWS)}")
    dissipation = joint_dissipation(**given, **shape._asdict())
    if dissipation is None:
        raise InputError("there is no friction to add; give a coefficient that is not zero, or take the scene as it is")
    laws = tuple(law for law in LAWS if law in given)
    return scene._replace(
        needs=scene.needs._replace(joint_friction=laws), dissipation=_both(scene.dissipation, dissipation)
    )


def _both(first: Dissipation | None, second: Dissipation) -> Dissipation:
    if first is None:
        return second

    def dissipation(q: Vector, qd: Vector) -> Scalar:
        return first(q, qd) + second(q, qd)

    return dissipation
