"""Energies made of networks, built from what a scene needs."""
