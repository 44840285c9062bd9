"""Data that are generated from scenes, and the published tasks."""
