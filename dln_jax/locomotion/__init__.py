"""Policies that move soft creatures: learned by gradients through the simulator, by evolution, or by PPO."""
