"""The models by name, and trained ones in folders: what describes a model, saves it and loads it."""
