"""Ways of learning to move, compared."""
