"""The two-link arm that writes letters: all models, compared with published results."""
