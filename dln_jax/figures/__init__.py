"""Figures of data, models and motions; every function returns a Matplotlib figure or writes a GIF."""

from dln_jax.figures.animations import write_frame_gif, write_motion_gif
from dln_jax.figures.closed_loop_animations import cart_pole_drawing, rotary_pendulum_drawing, write_closed_loop_gif
from dln_jax.figures.closed_loops import closed_loop_traces, phase_portrait
from dln_jax.figures.functions import ensemble, function_curves, heat_maps, parity, surfaces
from dln_jax.figures.joints import friction_curves
from dln_jax.figures.phase_space import injection_figure, motion_figure
from dln_jax.figures.soft_bodies import Moments, energies_against_time, moments_figure
from dln_jax.figures.soft_body_animations import soft_body_frame, write_soft_body_gif
from dln_jax.figures.soft_body_films import Slab, write_slab_film
from dln_jax.figures.torques import force_decomposition, tip_paths, torque_bands, torque_by_joint
from dln_jax.figures.training import training_curve

__all__ = [
    "Moments",
    "Slab",
    "cart_pole_drawing",
    "closed_loop_traces",
    "energies_against_time",
    "ensemble",
    "force_decomposition",
    "friction_curves",
    "function_curves",
    "heat_maps",
    "injection_figure",
    "moments_figure",
    "motion_figure",
    "parity",
    "phase_portrait",
    "rotary_pendulum_drawing",
    "soft_body_frame",
    "surfaces",
    "tip_paths",
    "torque_bands",
    "torque_by_joint",
    "training_curve",
    "write_closed_loop_gif",
    "write_frame_gif",
    "write_motion_gif",
    "write_slab_film",
    "write_soft_body_gif",
]
