"""What is measured of controllers: swing-ups from many starts, and a public board's acrobot and pendubot."""
