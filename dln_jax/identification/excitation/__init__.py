"""Excitation: Fourier-series motions within a robot's limits that give a well-conditioned regressor."""
