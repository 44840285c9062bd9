"""Friction and damping of obstacles that move: the speed relative to their surface counts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.softbody import AVERAGE_VECTOR_FIELD, BACKWARD_EULER, make_scene, make_step
from dln_jax.softbody.contact import box, capsule, half_space, heightfield, obstacle_contact, sphere
from dln_jax.softbody.contact.barrier import barrier
from dln_jax.softbody.contact.obstacles import Obstacle
from dln_jax.softbody.mesh import make_mesh
from dln_jax.softbody.terms import elastic, gravity, plane_contact, stable_neo_hookean
from dln_jax.softbody.terms.contact import motion_of
from dln_jax.types import InputError

SPEED, FRICTION, DT, STEPS = 0.5, 0.8, 5e-3, 40
NEAR = {"distance": 5e-3, "stiffness": 1e4, "friction": FRICTION, "name": "belt"}


def block(bottom=0.004):
    """Four triangles, 0.2 m x 0.1 m, at rest in the middle of x."""
    vertices = np.array([[x, y + bottom] for y in (0.0, 0.1) for x in (-0.1, 0.0, 0.1)])
    return make_mesh(vertices, np.array([[0, 1, 3], [1, 4, 3], [1, 2, 4], [2, 5, 4]]))


def scene_of(mesh, terms=(), contacts=()):
    material = elastic(mesh, stable_neo_hookean, youngs_modulus=1e6, poisson_ratio=0.3)
    return make_scene(mesh, [material, gravity(mesh), *terms], contacts=contacts)


def with_belt(params, **shape):
    """Parameters with another shape of the belt: an obstacle, or a plane."""
    belt = params.terms["belt"]
    belt = belt._replace(shape=belt.shape._replace(**shape)) if hasattr(belt, "shape") else belt._replace(**shape)
    return params._replace(terms={**params.terms, "belt": belt})


def carried(stepper, params_at, **start):
    """The last state, and the mean velocity in x and convergence of every step, with parameters at its end."""
    init, step = stepper

    def one(state, number):
        state, info = step(params_at(number), state)
        return state, (state.v[:, 0].mean(), info.converged)

    return jax.lax.scan(one, init(**start), jnp.arange(STEPS))


@pytest.fixture(scope="module")
def belt():
    # The block starts at the gap where the barrier carries its weight.
    gaps = np.linspace(1e-3, 5e-3, 1000)
    slopes = np.asarray(barrier(jnp.asarray(gaps**2), jnp.full(1000, 25e-6))[1])
    pressures = -2 * gaps * slopes * NEAR["stiffness"] / NEAR["distance"] ** 3
    mesh = block(np.interp(-1000 * 9.81 * 0.1, -pressures, gaps))
    return scene_of(mesh, contacts=[obstacle_contact(mesh, box([0.0, -0.05], [2.0, 0.05]), **NEAR)])


def travelled(belt, speed, integrator=BACKWARD_EULER, **settings):
    """Way of a block in m on a belt with this speed, its velocities, and convergence."""

    def params_at(number):
        return with_belt(belt.params, centre=jnp.stack([speed * DT * number, -0.05]))

    state, seen = carried(make_step(belt, DT, integrator, **settings), params_at)
    return state.x[:, 0].mean(), seen


@pytest.mark.parametrize("integrator", [BACKWARD_EULER, AVERAGE_VECTOR_FIELD])
def test_a_belt_carries_a_block_along_by_coulombs_law(belt, integrator):
    way, (v, converged) = jax.jit(lambda: travelled(belt, SPEED, integrator))()
    assert converged.all()
    assert v[20:].mean() == pytest.approx(SPEED, rel=0.03)
    assert v.max() < 1.1 * SPEED
    # It accelerates at mu g up to the speed of the belt, which is at rest in the first step.
    sticking = SPEED / (FRICTION * 9.81)
    assert way == pytest.approx(SPEED * ((STEPS - 1) * DT - sticking / 2), rel=0.05)


@pytest.mark.slow
def test_divided_steps_and_derivatives_take_the_motion_of_a_belt(belt):
    settings = {"tolerance": 1e-9, "halvings": 2, "iterations": 14}
    way = jax.jit(lambda speed: travelled(belt, speed, **settings))
    slope = jax.jit(jax.grad(lambda speed: travelled(belt, speed, **settings)[0]))(0.3)
    (more, (v, converged)), (less, _) = way(0.3 + 1e-5), way(0.3 - 1e-5)
    assert converged.all()
    assert v[-1] == pytest.approx(0.3, rel=0.01)
    assert float(slope) == pytest.approx(float(more - less) / 2e-5, rel=1e-4)


def test_a_plane_that_turns_about_the_origin_carries_a_block_along():
    # At a distance of 2 m from the origin, the plane moves along itself by 0.5 m/s.
    mesh, radius = block(2.0), 2.0
    near = {"stiffness": 1e5, "width": 1e-3, "friction": FRICTION, "name": "belt"}
    scene = scene_of(mesh, [plane_contact(range(6), normal=[0.0, 1.0], offset=radius, **near)])

    def params_at(number):
        angle = SPEED / radius * DT * number
        return with_belt(scene.params, normal=3.0 * jnp.stack([jnp.sin(angle), jnp.cos(angle)]))

    _, (v, converged) = jax.jit(lambda: carried(make_step(scene, DT), params_at))()
    assert converged.all()
    assert v[25:].mean() == pytest.approx(SPEED, rel=0.05)


def test_damping_takes_the_velocity_of_a_plane():
    # A body falls on a plane, or the plane rises against the body: the same motion for two observers.
    mesh = block(0.001)
    ground = plane_contact(range(6), normal=[0.0, 1.0], stiffness=1e5, width=1e-4, damping=1.0, name="belt")
    material = elastic(mesh, stable_neo_hookean, youngs_modulus=1e6, poisson_ratio=0.3)
    scene = make_scene(mesh, [material, ground])

    def motion(rise, v):
        def params_at(number):
            return with_belt(scene.params, offset=rise * 1e-3 * number)

        # The first step takes the plane to be at rest, before it touches the body.
        start = jnp.stack([0.0, v])
        return carried(make_step(scene, 1e-3), params_at, x=mesh.vertices - 1e-3 * start, v=start)[0].v

    rising, falling = jax.jit(lambda: jax.lax.map(lambda case: motion(*case), jnp.array([[1.0, 0.0], [0.0, -1.0]])))()
    np.testing.assert_allclose(rising - falling, np.broadcast_to([0.0, 1.0], (6, 2)), atol=1e-6)
    assert falling[:, 1].mean() > -0.5


def rotation(angle, axis):
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


def test_points_of_obstacles_move_rigidly():
    axis = np.array([1.0, 2.0, -1.0])
    turn, shift, x = rotation(0.4, axis), np.array([0.3, -0.1, 0.2]), np.random.default_rng(0).normal(size=(5, 3))
    mesh = make_mesh(np.eye(4, 3) + np.array([20.0, -10.0, 10.0]), np.array([[0, 1, 2, 3]]))

    def moved(before, after):
        one, other = (obstacle_contact(mesh, obstacle, **NEAR).parameters for obstacle in (before, after))
        return x + np.asarray(motion_of("belt", other, {"belt": one.pose}, jnp.asarray(x)))

    sides, centre, normal = rotation(1.0, (0.0, 1.0, 1.0)), np.array([0.1, 0.2, 0.3]), np.array([2.0, -1.0, 0.0])
    lengths, end, across = [1.0, 1.0, 1.0], centre + normal, normal / np.linalg.norm(normal)
    ground, lower = heightfield(np.zeros((4, 4)), [0.1, 0.2], 0.5), heightfield(np.zeros((4, 4)), [0.4, 0.1], 0.5)
    cases = {
        "box": (box(centre, lengths, sides), box(turn @ centre + shift, lengths, sides @ turn.T), x @ turn.T + shift),
        # Planes and capsules turn without spinning, here about an axis that is normal to theirs.
        "plane": (half_space(normal, 0.3), half_space(turn @ normal, 0.5), (x + 0.2 * across) @ turn.T),
        "capsule": (
            capsule(centre, end, 0.1),
            capsule(turn @ centre + shift, turn @ end + shift, 0.1),
            x @ turn.T + shift,
        ),
        "sphere": (sphere(centre, 0.2), sphere(centre + shift, 0.2), x + shift),
        "heightfield": (ground, lower, x + np.array([0.3, -0.1, 0.0])),
    }
    for name, (before, after, expected) in cases.items():
        np.testing.assert_allclose(moved(before, after), expected, atol=1e-13, err_msg=name)
        np.testing.assert_array_equal(moved(before, before), x, err_msg=name)


def test_friction_of_an_obstacle_without_pose_is_refused():
    own = Obstacle(lambda x, height: x[1] - height, jnp.asarray(0.0))
    with pytest.raises(InputError, match="pose"):
        obstacle_contact(block(), own, **NEAR)
    assert obstacle_contact(block(), own, distance=5e-3, stiffness=1e4).parameters.pose is None
