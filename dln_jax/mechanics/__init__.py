"""The physics of any energy, for one state: no batch axis, no network."""
