"""Value functions of published plants: plants, reference values, and returns of their policies."""
