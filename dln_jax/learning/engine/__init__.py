"""The training loop `fit`, its optimisers as records, and the checkpoints of a run."""
