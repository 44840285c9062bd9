"""Any scene with the friction that the joints of a laboratory have: viscous, dry, and more of it at rest."""

from dln_jax.mechanics.friction import FrictionCoefficients, FrictionShape, joint_dissipation
from dln_jax.scenes.scene import Scene
from dln_jax.types import Dissipation, FrictionLaw, InputError, Scalar, Vector

LAWS: tuple[FrictionLaw, ...] = ("viscous", "coulomb", "stribeck")
"""That a scene can be given; the others of `mechanics.friction.laws` belong to gears."""


def with_friction(
    scene: Scene,
    coefficients: FrictionCoefficients,
    shape: FrictionShape = FrictionShape(),  # noqa: B008
) -> Scene:
    """The same scene with friction in its joints, beside any that it has.

    Dry friction is c tanh(u / v) with a small v, `shape.velocity_scale`: a joint that "rests" creeps with less than it.
    An explicit integrator is stable for steps below some 2.8 m v / c, with m the least inertia that the joint sees.

    Args:
        scene: of any joints.
        coefficients: viscous, coulomb and stribeck, a number for each joint or one for all.
        shape: velocity scale and Stribeck's velocity.

    Raises:
        InputError: no coefficient, one of another law, or one that is negative.
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
