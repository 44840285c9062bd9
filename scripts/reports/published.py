"""Published numbers: a literal table per source, by case and quantity, in the units of the rows beside them."""

from collections.abc import Mapping
from typing import NamedTuple


class Published(NamedTuple):
    """Numbers of one source."""

    source: str
    values: Mapping[str, Mapping[str, float]]
    """Numbers by case and quantity."""


def published(table: Published, case: str, quantity: str) -> float | None:
    """One number of a table; `None` if it is not published."""
    return table.values.get(case, {}).get(quantity)


def _of_the_arm(torque: str, rows: Mapping[str, tuple[float, ...]]) -> dict[str, dict[str, float]]:
    """Names the columns of rows: torque, optionally its three parts, and prediction time."""
    parts = ("inertial_mse", "coriolis_mse", "gravity_mse")
    return {
        case: dict(zip((torque, *parts, "vpt_seconds") if len(row) > 2 else (torque, "vpt_seconds"), row, strict=True))
        for case, row in rows.items()
    }


ARM = Published(
    "Lutter et al. (2019), Lutter and Peters (2021), means of ten seeds; mean squared errors are sums over joints. "
    "Valid prediction times of the swings are means over all three motions, from the stored results; the printed ones "
    "(5.7, 3.6, 5.1, 3.8, 2.5) leave the last motion out",
    _of_the_arm(
        "torque_mse",
        {
            "structured-delan/characters": (2.2e-5, 3.2e-5, 1.4e-5, 2.0e-5, 2.3),
            "black-box-delan/characters": (2.8e-5, 1.8e-5, 2.0e-5, 1.2e-5, 2.8),
            "feed-forward/characters": (6.2e-4, 7.8e-4, 6.4e-4, 1.1e-4, 1.8),
            "structured-delan/uniform": (2.6e-4, 5.99),
            "black-box-delan/uniform": (2.5e-1, 4.76),
            "feed-forward/uniform": (7.0e-2, 3.77),
        },
    )
    # Torques of the Hamiltonians were computed from recorded rates of momenta.
    | _of_the_arm(
        "torque_from_momenta_mse",
        {
            "structured-hnn/characters": (5.4e-6, 2.8e-6, 6.2e-6, 2.8e-6, 2.9),
            "black-box-hnn/characters": (1.6e-5, 8.6e-3, 8.5e-3, 1.0e-5, 2.2),
            "structured-hnn/uniform": (5.5e-4, 5.82),
            "black-box-hnn/uniform": (4.0e-2, 4.84),
        },
    ),
)
PUBLISHED_CODE = Published(
    "the published implementation of the structured Lagrangian, measured on two cores",
    {"structured-delan": {"train_seconds": 108.0, "one_step_p50_us": 111.0}},
)
HAMILTONIAN = Published(
    "Greydanus, Dzamba and Yosinski (2019): their baseline and their Hamiltonian network; those of pixels are of other "
    "pictures, and of an energy in other units",
    {
        "spring/phase-network": {"test_loss": 3.67e-2, "energy_mse": 1.7e-1},
        "spring/black-box-hnn": {"test_loss": 3.59e-2, "energy_mse": 3.8e-4},
        "pendulum/phase-network": {"test_loss": 3.53e-2, "published_energy_mse": 4.2e-2},
        "pendulum/black-box-hnn": {"test_loss": 3.56e-2, "published_energy_mse": 2.5e-2},
        "real-pendulum/phase-network": {"energy_mse": 3.9e-1},
        "real-pendulum/black-box-hnn": {"energy_mse": 1.4e-2},
        "two-body/phase-network": {"test_loss": 3.0e-5, "energy_mse": 6.3e-2},
        "two-body/black-box-hnn": {"test_loss": 2.8e-6, "energy_mse": 3.9e-5},
        "three-body/phase-network": {"test_loss": 3.8e-1, "energy_mse": 1.1e2},
        "three-body/black-box-hnn": {"test_loss": 4.9e-1, "energy_mse": 4.2e-2},
        "pixels/phase-network": {"test_loss": 1.73e-4, "energy_mse": 9.3e-3},
        "pixels/black-box-hnn": {"test_loss": 1.85e-4, "energy_mse": 1.5e-4},
    },
)
DIFFERENTIAL_NETWORKS = Published(
    "the published table of deep differential networks: functions, losses and activations, Adam on 128 units per layer",
    {
        "sin/type1/relu": {"value_mse": 9.8e-6, "gradient_mse": 4.5e-4, "hessian_mse": 5.0e-1},
        "sin/type1/softplus": {"value_mse": 6.9e-6, "gradient_mse": 1.8e-4, "hessian_mse": 5.9e-3},
        "sin/type1/tanh": {"value_mse": 8.2e-7, "gradient_mse": 3.1e-5, "hessian_mse": 1.6e-3},
        "sin/type1/cos": {"value_mse": 2.0e-7, "gradient_mse": 2.2e-6, "hessian_mse": 5.5e-5},
        "sin/type2/relu": {"value_mse": 5.1e-7, "gradient_mse": 2.7e-3, "hessian_mse": 5.0e-1},
        "sin/type2/softplus": {"value_mse": 8.7e-6, "gradient_mse": 1.5e-4, "hessian_mse": 4.5e-3},
        "sin/type2/tanh": {"value_mse": 7.6e-6, "gradient_mse": 4.3e-4, "hessian_mse": 8.6e-3},
        "sin/type2/cos": {"value_mse": 1.7e-8, "gradient_mse": 5.7e-7, "hessian_mse": 1.2e-5},
        "cos_sin/type1/relu": {"value_mse": 4.2e-5, "gradient_mse": 2.0e-3, "hessian_mse": 1.0},
        "cos_sin/type1/softplus": {"value_mse": 2.9e-6, "gradient_mse": 3.7e-5, "hessian_mse": 1.3e-3},
        "cos_sin/type1/tanh": {"value_mse": 2.6e-6, "gradient_mse": 1.5e-5, "hessian_mse": 8.5e-4},
        "cos_sin/type1/cos": {"value_mse": 2.9e-7, "gradient_mse": 4.3e-6, "hessian_mse": 1.7e-4},
        "cos_sin/type2/relu": {"value_mse": 3.3e-5, "gradient_mse": 5.0e-3, "hessian_mse": 1.0},
        "cos_sin/type2/softplus": {"value_mse": 4.3e-5, "gradient_mse": 8.1e-4, "hessian_mse": 1.5e-2},
        "cos_sin/type2/tanh": {"value_mse": 8.4e-6, "gradient_mse": 4.3e-4, "hessian_mse": 1.2e-2},
        "cos_sin/type2/cos": {"value_mse": 2.1e-6, "gradient_mse": 7.0e-5, "hessian_mse": 1.3e-3},
    },
)
