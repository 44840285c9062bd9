"""Controllers from known or learned energies: tracking, regulators, swing-up, and the closed loop around them."""
