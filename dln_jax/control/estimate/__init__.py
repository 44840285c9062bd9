"""State estimation: Kalman filters, their noise from logs, and external torques.

process = mechanical(model, B, rate=500.0, band=[0.3, 1e-3], encoder_step=[2.3e-5, 3.1e-3])
controller = with_estimate(law, process, belief(x, 0.1), rate=500.0, controls=1, delay=1)
"""
