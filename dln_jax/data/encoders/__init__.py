"""Encoder logs: convert noisy q, t and tau at an arbitrary rate to trajectories with derivatives.

`smooth(data)` resamples, filters without delay, differentiates, trims and decimates, and reports the settings chosen.
`smooth_locally(data)` does without equal steps, for motions of a few dozen samples.
"""
