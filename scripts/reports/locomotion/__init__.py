"""Ways of learning to move compared: what each needs until a creature travels five body lengths."""
