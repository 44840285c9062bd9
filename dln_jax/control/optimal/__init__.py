"""Optimal feedback from value functions: a network for the cost to go, and its greedy control."""
