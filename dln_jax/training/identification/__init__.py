"""Fits to motions, which identify and learned trees share."""
