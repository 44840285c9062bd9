"""Energies built from networks and bases for the needs of a scene."""
