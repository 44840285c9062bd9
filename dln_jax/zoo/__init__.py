"""Models by name, their descriptions, and trained models saved to and loaded from folders."""
