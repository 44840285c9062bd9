"""Measurements of robots: identification, tracking, learned kinematics, real logs and speed."""
