"""The two-link arm that writes: every model, beside the published results."""
