"""Train Hamiltonian models and baselines on the published tasks, and print their errors beside the published ones.

Models: what suits the scene (separable-hnn or pairwise-hnn, with friction where it has it), black-box-hnn (one network
is H), phase-network (one gives the rates). Each is trained on the published data (those of seed 0) from several seeds;
numbers are medians over these. The real pendulum is measured where its file is given.

--only own --own FOLDER compares instead: files TASK-SEED.npz of the published protocols, learned as own data
(train_hnn_task --task measured) with their needs stated and without, beside the named tasks on the same starts.
"""

from scripts.reports.hamiltonian import images, own_files, phase_task, real_pendulum
from scripts.reports.run import Case

TINY = {"seeds": 1, "steps": 5, "trajectories": 10}
# Greydanus, Dzamba and Yosinski (2019): their baseline and their Hamiltonian network; those of pixels are of other
# pictures, and of an energy in other units.
PUBLISHED = {
    "spring": ({"test_loss": 3.67e-2, "energy_mse": 1.7e-1}, {"test_loss": 3.59e-2, "energy_mse": 3.8e-4}),
    "pendulum": (
        {"test_loss": 3.53e-2, "published_energy_mse": 4.2e-2},
        {"test_loss": 3.56e-2, "published_energy_mse": 2.5e-2},
    ),
    "real-pendulum": ({"energy_mse": 3.9e-1}, {"energy_mse": 1.4e-2}),
    "two-body": ({"test_loss": 3.0e-5, "energy_mse": 6.3e-2}, {"test_loss": 2.8e-6, "energy_mse": 3.9e-5}),
    "three-body": ({"test_loss": 3.8e-1, "energy_mse": 1.1e2}, {"test_loss": 4.9e-1, "energy_mse": 4.2e-2}),
    "pixels": ({"test_loss": 1.73e-4, "energy_mse": 9.3e-3}, {"test_loss": 1.85e-4, "energy_mse": 1.5e-4}),
}
# Bounds for the model that suits the scene.
BOUNDS = {
    "spring": ("separable-hnn", {"energy_mse": 3.8e-5, "train_seconds": 5.0}),
    "pendulum": ("separable-hnn", {"published_energy_mse": 2.5e-3, "train_seconds": 8.0}),
    "real-pendulum": ("separable-hnn", {"energy_mse": 8e-4, "train_seconds": 60.0}),
    "two-body": ("pairwise-hnn", {"energy_mse": 3.9e-6, "train_seconds": 30.0}),
    "three-body": ("pairwise-hnn", {"energy_mse": 4.2e-3, "energy_mse_median": 4.2e-3, "train_seconds": 300.0}),
    "pixels": ("black-box-hnn", {"energy_mse": 1.5e-4, "energy_mse_over_baseline": 0.1, "train_seconds": 300.0}),
}
FUNCTIONS = {"real-pendulum": real_pendulum, "pixels": images}


def published(task: str) -> dict[str, float]:
    """Numbers of the published network for every model but the baseline."""
    baseline, network = PUBLISHED[task]
    return {**network, **{f"{task}/phase-network {quantity}": value for quantity, value in baseline.items()}}


CASES = (
    *(
        Case(
            task,
            FUNCTIONS.get(task, phase_task),
            {} if task in FUNCTIONS else {"task": task},
            TINY if task != "real-pendulum" else {"seeds": 1, "steps": 5},
            published(task),
            {f"{task}/{model} {quantity}": bound for quantity, bound in bounds.items()},
        )
        for task, (model, bounds) in BOUNDS.items()
    ),
    Case("own", own_files, quick={"seeds": 1, "steps": 5}, bound={"over_named_task": 2.0}, by_name_only=True),
)
