"""Policies of soft creatures: stored ones, their verdict, and figures of the learning and of the gait."""
