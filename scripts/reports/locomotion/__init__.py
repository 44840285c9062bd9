"""Gradients and PPO compared: what each needs until a creature travels five body lengths."""
