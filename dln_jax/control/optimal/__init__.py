"""Optimal feedback from value functions: a network for the cost to go, and its greedy control."""

from dln_jax.control.optimal import action_costs
from dln_jax.control.optimal.action_costs import ActionCost
from dln_jax.control.optimal.fitted import FittedValue, Iteration, fit_value, fit_values
from dln_jax.control.optimal.grid import GridValue, extrapolated, lookahead, solve_on_grid
from dln_jax.control.optimal.grid_interpolation import Grid, interpolated
from dln_jax.control.optimal.problem import (
    Affine,
    ControlProblem,
    at_goal,
    checked,
    from_field,
    from_plant,
    hjb_policy,
    hjb_residual,
    optimal_control,
    rates,
)
from dln_jax.control.optimal.residual import HJBFit, ResidualStage, discounts_down_to, fit_hjb
from dln_jax.control.optimal.value_networks import ValueNetwork, value_network
from dln_jax.control.optimal.worst_case import Bounds, worst_disturbance

__all__ = [
    "ActionCost",
    "Affine",
    "Bounds",
    "ControlProblem",
    "FittedValue",
    "Grid",
    "GridValue",
    "HJBFit",
    "Iteration",
    "ResidualStage",
    "ValueNetwork",
    "action_costs",
    "at_goal",
    "checked",
    "discounts_down_to",
    "extrapolated",
    "fit_hjb",
    "fit_value",
    "fit_values",
    "from_field",
    "from_plant",
    "hjb_policy",
    "hjb_residual",
    "interpolated",
    "lookahead",
    "optimal_control",
    "rates",
    "solve_on_grid",
    "value_network",
    "worst_disturbance",
]
