"""Measurements of controllers, such as swing-ups from many starts and a public board's acrobot and pendubot."""
