"""Figures of data, models and motions; every function returns a Matplotlib figure or writes a film."""
