"""Training: from data to a run folder with a model, test errors and figures."""
