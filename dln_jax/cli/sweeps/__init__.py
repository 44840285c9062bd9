"""Many runs of one command: a grid of its options as independent jobs, on engines that exist, and what came of them."""

__all__ = []
