"""Optimal feedback by value functions: the cost to go as a network, and the control that descends it best."""
