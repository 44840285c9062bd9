"""Friction curves: a panel for each joint, every curve and the measured points in it."""

import numpy as np

from dln_jax.figures import friction_curves


def test_each_joint_has_its_curves_in_the_order_of_its_rates():
    rates = np.random.default_rng(0).normal(size=(50, 5))
    figure = friction_curves({"fit": (rates, np.tanh(rates)), "plant": (rates, rates)}, measured=(rates, rates**2))
    shown = [axis for axis in figure.axes if axis.get_visible()]
    assert len(shown) == 5 and [axis.get_title() for axis in shown][-1] == "joint 5"
    points, fit, plant = shown[4].lines[:3]
    np.testing.assert_array_equal(points.get_ydata(), rates[:, 4] ** 2)
    np.testing.assert_array_equal(fit.get_xdata(), np.sort(rates[:, 4]))
    np.testing.assert_array_equal(plant.get_ydata(), np.sort(rates[:, 4]))
