"""Trains models of a robot's torques: options, data, model, fit and evaluation."""
