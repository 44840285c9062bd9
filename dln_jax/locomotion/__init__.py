"""Locomotion of soft creatures: policies learned by gradients through the simulator."""
