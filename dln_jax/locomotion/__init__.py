"""Policies of soft creatures, learned by gradients through the simulator."""
