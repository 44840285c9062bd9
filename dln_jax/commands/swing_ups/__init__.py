"""Swing-ups of plants that are learned from their motions: any plant, and desktop plants with laws of given gains."""
