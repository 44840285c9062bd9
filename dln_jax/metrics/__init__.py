"""Numbers about a model: errors, predictions, speed."""
