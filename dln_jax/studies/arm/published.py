"""Published results on the two-link arm (Lutter et al. 2019, 2021; ten seeds), by kind of model and data set.

Mean squared errors in (N m)², sums over joints; valid prediction times in s. Those of the swings are means over all
three motions, from the stored results; the printed ones (5.7, 3.6, 5.1, 3.8, 2.5) leave the last motion out.
"""

COLUMNS = {
    "characters": ("torque_mse", "inertial_mse", "coriolis_mse", "gravity_mse", "vpt_seconds"),
    "uniform": ("torque_mse", "vpt_seconds"),
}
PUBLISHED = {
    "structured-delan": {"characters": (2.2e-5, 3.2e-5, 1.4e-5, 2.0e-5, 2.3), "uniform": (2.6e-4, 5.99)},
    "black-box-delan": {"characters": (2.8e-5, 1.8e-5, 2.0e-5, 1.2e-5, 2.8), "uniform": (2.5e-1, 4.76)},
    "structured-hnn": {"characters": (5.4e-6, 2.8e-6, 6.2e-6, 2.8e-6, 2.9), "uniform": (5.5e-4, 5.82)},
    "black-box-hnn": {"characters": (1.6e-5, 8.6e-3, 8.5e-3, 1.0e-5, 2.2), "uniform": (4.0e-2, 4.84)},
    "feed-forward": {"characters": (6.2e-4, 7.8e-4, 6.4e-4, 1.1e-4, 1.8), "uniform": (7.0e-2, 3.77)},
}


def published(kind: str, dataset: str, quantity: str) -> float | None:
    """One number of the published table; `None` where it has none.

    The torques of the Hamiltonians were computed from recorded rates of momenta, so that `torque_from_momenta_mse` is
    theirs and `torque_mse` is not.
    """
    if kind.endswith("hnn") and "torque" in quantity:
        quantity = "torque_mse" if quantity == "torque_from_momenta_mse" else ""
    if kind not in PUBLISHED or quantity not in COLUMNS[dataset]:
        return None
    return PUBLISHED[kind][dataset][COLUMNS[dataset].index(quantity)]
