"""Plants of any origin as four callables: adapters, safety, exploration, tuning and trials."""

from dln_jax.control.plants.estimators import ESTIMATORS, Estimator, by_differences, by_filter, estimator_of
from dln_jax.control.plants.exploring import Exploration, Explored, explore
from dln_jax.control.plants.guarded import Stopped, guarded
from dln_jax.control.plants.mujoco_plants import mujoco_plant
from dln_jax.control.plants.outside_loops import gymnasium_plant, hardware_plant
from dln_jax.control.plants.plant import Layout, Limits, Plant, layout
from dln_jax.control.plants.runs import PlantRun, Trials, compiled, judged_runs, run, start_of
from dln_jax.control.plants.simulated import plant_of, simulated
from dln_jax.control.plants.tuning import Tuned, tune

__all__ = [
    "ESTIMATORS",
    "Estimator",
    "Exploration",
    "Explored",
    "Layout",
    "Limits",
    "Plant",
    "PlantRun",
    "Stopped",
    "Trials",
    "Tuned",
    "by_differences",
    "by_filter",
    "compiled",
    "estimator_of",
    "explore",
    "guarded",
    "gymnasium_plant",
    "hardware_plant",
    "judged_runs",
    "layout",
    "mujoco_plant",
    "plant_of",
    "run",
    "simulated",
    "start_of",
    "tune",
]
