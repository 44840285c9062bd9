"""Fits trees of unknown kinematics: joint frames by Gauss-Newton from random starts, the rest by elimination.

fit = fit_tree(needs, train, validation)
make_serial_tree(needs).energies(fit.parameters)
"""
