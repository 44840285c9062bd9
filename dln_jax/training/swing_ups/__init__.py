"""Swing-up of a plant: exploration, learning, control and animation."""
