"""State estimation: Kalman filters, filters in control loops, and external torques.

    process = mechanical(model, B, rate=500.0, band=[0.3, 1e-3], encoder_step=[2.3e-5, 3.1e-3])
    controller = with_estimate(law, extended(process), belief(x, 0.1), controls=1, measurements=2, delay=1)

`extended` and `unscented` make filters of a process. Both have the same three pure functions `start`,
`predict` and `update`, for one state.
"""
