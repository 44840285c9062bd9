"""Datasets generated from scenes, and the published tasks."""
