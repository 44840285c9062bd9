"""What commands share: typed arguments, run folders, one-line errors, progress and tables."""
