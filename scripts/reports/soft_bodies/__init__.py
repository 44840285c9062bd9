"""Soft bodies: closed forms, hard cases, gradients and speed, compared with expected values."""
