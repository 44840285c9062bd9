"""The published numbers of the Hamiltonian tasks, the figures to reach, and the table's rows beside them."""

from dln_jax.studies.hamiltonian.tasks import REAL
from dln_jax.studies.report import Row

PIXELS = "pixels"
PUBLISHED = {
    "spring": {"test_loss": (3.67e-2, 3.59e-2), "energy_mse": (1.7e-1, 3.8e-4)},
    "pendulum": {"test_loss": (3.53e-2, 3.56e-2), "published_energy_mse": (4.2e-2, 2.5e-2)},
    REAL: {"energy_mse": (3.9e-1, 1.4e-2)},
    "two-body": {"test_loss": (3.0e-5, 2.8e-6), "energy_mse": (6.3e-2, 3.9e-5)},
    "three-body": {"test_loss": (3.8e-1, 4.9e-1), "energy_mse": (1.1e2, 4.2e-2)},
    PIXELS: {"test_loss": (1.73e-4, 1.85e-4), "energy_mse": (9.3e-3, 1.5e-4)},
}
"""Of the published baseline and Hamiltonian network (Greydanus, Dzamba and Yosinski 2019); those of pixels are of other
pictures, and of an energy in other units."""
BOUNDS = {
    "spring": {"energy_mse": 3.8e-5, "train_seconds": 5.0},
    "pendulum": {"published_energy_mse": 2.5e-3, "train_seconds": 8.0},
    REAL: {"energy_mse": 8e-4, "train_seconds": 60.0},
    "two-body": {"energy_mse": 3.9e-6, "train_seconds": 30.0},
    "three-body": {"energy_mse": 4.2e-3, "energy_mse_median": 4.2e-3, "train_seconds": 300.0},
    PIXELS: {"energy_mse": 1.5e-4, "energy_mse_over_baseline": 0.1, "train_seconds": 300.0},
}
"""For the model that suits the scene."""


def rows_of(case: str, numbers: dict[str, float]) -> list[Row]:
    """The report's rows of a case, with the published value and the bound where there are."""
    task, kind = case.split("/")
    rows = []
    for quantity, value in numbers.items():
        published = PUBLISHED[task].get(quantity)
        reference = None if published is None else published[0 if kind == "baseline" else 1]
        bound = BOUNDS[task].get(quantity) if kind == "hnn" else None
        unit = "s" if quantity.endswith("seconds") else "1"
        rows.append(Row(case, quantity, value, unit, reference, bound))
    return rows


TITLES = {
    "test_loss": "test loss",
    "clean_field_mse": "clean field",
    "energy_mse": "energy MSE",
    "published_energy_mse": "energy MSE, q²+p²",
    "rollout_mse": "rollout MSE",
    "train_seconds": "training, s",
}


def markdown(found: dict[str, dict[str, float]]) -> str:
    """Ours / published, a line per case."""
    lines = [["task / model", *TITLES.values()], ["---"] * (len(TITLES) + 1)]
    for case, numbers in found.items():
        task, kind = case.split("/")
        cells = []
        for quantity in TITLES:
            value, published = numbers.get(quantity), PUBLISHED[task].get(quantity)
            text = "" if value is None else f"{value:.1f}" if quantity == "train_seconds" else f"{value:.1e}"
            if f"{quantity}_standard_error" in numbers:
                text += f" ± {numbers[f'{quantity}_standard_error']:.0e}"
            if value is not None and published is not None and kind in ("hnn", "baseline"):
                text += f" / {published[0 if kind == 'baseline' else 1]:.1e}"
            cells.append(text)
        lines.append([case, *cells])
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
