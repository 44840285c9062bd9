"""Textbook systems: what each needs, and its exact energies and equations of motion."""
