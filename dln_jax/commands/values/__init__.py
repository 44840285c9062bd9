"""Value functions of published plants and of a user's own: plants, training, evaluation, figures."""
