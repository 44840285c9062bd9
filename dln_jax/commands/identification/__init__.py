"""Parts of the command identify: its log, its fit, and its verdict."""
