"""Learning: what is made small, and how."""
