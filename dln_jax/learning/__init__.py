"""Residuals, optimisers, the fit loop and its checkpoints."""
