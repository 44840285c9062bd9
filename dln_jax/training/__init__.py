"""From a user's data to a run folder: training, errors, figures."""

__all__: list[str] = []
