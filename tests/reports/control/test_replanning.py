"""Nine numbers determine the board's plant, and its motion determines them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.mechanics.integrators import CLASSICAL, runge_kutta
from dln_jax.scenes.pendulums import Links
from scripts.reports.control.board import RATE, plant
from scripts.reports.control.disturbed_board import LONGEST, disturbed, undisturbed
from scripts.reports.control.replanning import GRAVITY, Estimate, field_for, nominal, updated

X, U = jnp.array([0.4, 1.1, -2.0, 3.0]), jnp.array([1.5])


def numbers_of(links, viscous, dry, rotor):
    (m1, m2), (l1, _), (r1, r2), (I1, I2) = links.masses, links.lengths, links.centres, links.inertias
    inertial = [I1 + m2 * l1**2, I2, m2 * l1 * r2, GRAVITY * (m1 * r1 + m2 * l1)]
    return np.array([*inertial, *viscous, *dry, rotor])


HEAVY = Links()._replace(masses=(Links().masses[0], 1.2 * Links().masses[1]))


@pytest.mark.parametrize("motor", ["elbow", "shoulder"])
def test_nine_numbers_are_the_plant(motor):
    B = plant(motor)[1]
    changed = undisturbed()._replace(
        links=HEAVY, viscous=np.array([0.05, -0.03]), dry=np.array([0.1, 0.2]), rotor=8e-5
    )  # fmt: skip
    p = jnp.asarray(numbers_of(HEAVY, [0.05, -0.03], [0.1, 0.2], 8e-5))
    np.testing.assert_allclose(field_for(p, B)(X, U), disturbed(motor, changed)(X, B @ U), rtol=1e-9)
    np.testing.assert_allclose(nominal()[0], numbers_of(Links(), [0, 0], [0, 0], 0.0), rtol=1e-12)


def test_a_motion_shows_which_plant_it_is():
    motor, B = "shoulder", plant("shoulder")[1]
    field = disturbed(motor, undisturbed()._replace(links=HEAVY, viscous=np.array([0.0, 0.03])))

    def sample(carry, number):
        x, u, estimate = carry
        estimate = updated(motor, estimate, x[:2], u, jnp.asarray(0), jnp.asarray(True))
        u = 4 * jnp.sin(jnp.stack([0.01 * number]))
        x = runge_kutta(CLASSICAL, lambda t, x: field(x, B @ u))(0.0, x, 1 / RATE)
        return (x, u, estimate), None

    nothing = jnp.zeros(9), jnp.eye(9), jnp.zeros((3, 2)), jnp.zeros(LONGEST + 3), jnp.asarray(0)
    start = jnp.zeros(4), jnp.zeros(1), Estimate(*nothing)
    (_, _, estimate), _ = jax.jit(lambda: jax.lax.scan(sample, start, jnp.arange(1000)))()
    centre, size = nominal()
    found_numbers = centre + size * np.asarray(estimate.numbers)
    truth = numbers_of(HEAVY, [0.0, 0.03], [0.0, 0.0], 0.0)
    before, after = np.abs(centre - truth)[:4] / truth[:4], np.abs(found_numbers - truth)[:4] / truth[:4]
    # Of the second link's numbers, its inertia about the joint stays, the coupling and the weight change.
    assert before.max() > 0.15 and after.max() < 0.04
    assert abs(found_numbers[5] - 0.03) < 0.005
