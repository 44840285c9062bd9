"""The ways of fitting a model to trajectories with torques: a module each, with a `METHOD`."""
