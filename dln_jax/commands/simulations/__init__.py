"""Simulations of soft bodies: scenes from options and meshes, and motions with their metrics and figures."""
