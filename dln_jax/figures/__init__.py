"""Pictures of data, models and motions."""
