"""Swinging up a plant: explore, learn, control, film."""
