"""Controllers from known or learned energies: tracking, regulators, swing-up, and the closed loop around them."""

from dln_jax.control.balance import Region, error, region_of_attraction, regulated, switched, value
from dln_jax.control.closed_loop import Controller, Hardware, Run, following, simulate, stateless, with_differences
from dln_jax.control.delays import with_prediction
from dln_jax.control.energy_shaping import (
    EnergyGains,
    Parts,
    energy_shaping,
    partial_linearisation,
    parts_of,
    passive_energy,
)
from dln_jax.control.finite import where_finite
from dln_jax.control.friction_compensation import friction_compensation, without_friction
from dln_jax.control.judgement import Judgement, judged
from dln_jax.control.outcomes import Outcomes, outcomes
from dln_jax.control.quadratic import Regulator, SampledRegulators, lqr, sampled_lqr, time_varying_lqr
from dln_jax.control.shooting import Shooting, shoot
from dln_jax.control.state_space import Linearisation, field_of, holding_controls, integrated, linearise
from dln_jax.control.swing_up import SwingUp, SwingUpNumbers, swing_up
from dln_jax.control.tracking import (
    Gains,
    Reference,
    Tracker,
    computed_torque,
    feed_forward,
    gravity_compensation,
    limited,
    trusted,
)
from dln_jax.control.trajectories import Plan, Problem, first_plan, improve, mpc, optimise

__all__ = [
    "Controller",
    "EnergyGains",
    "Gains",
    "Hardware",
    "Judgement",
    "Linearisation",
    "Outcomes",
    "Parts",
    "Plan",
    "Problem",
    "Reference",
    "Region",
    "Regulator",
    "Run",
    "SampledRegulators",
    "Shooting",
    "SwingUp",
    "SwingUpNumbers",
    "Tracker",
    "computed_torque",
    "energy_shaping",
    "error",
    "feed_forward",
    "field_of",
    "first_plan",
    "following",
    "friction_compensation",
    "gravity_compensation",
    "holding_controls",
    "improve",
    "integrated",
    "judged",
    "limited",
    "linearise",
    "lqr",
    "mpc",
    "optimise",
    "outcomes",
    "partial_linearisation",
    "parts_of",
    "passive_energy",
    "region_of_attraction",
    "regulated",
    "sampled_lqr",
    "shoot",
    "simulate",
    "stateless",
    "swing_up",
    "switched",
    "time_varying_lqr",
    "trusted",
    "value",
    "where_finite",
    "with_differences",
    "with_prediction",
    "without_friction",
]
