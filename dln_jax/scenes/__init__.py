"""Textbook systems: their `Needs`, exact energies and equations of motion."""
