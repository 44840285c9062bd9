"""Swing up a pole with a model learned from its motion.

Explores the plant, learns a model, designs a controller, and closes the loop. The plant is an MJCF or URDF file: a
cart-pole, a rotary pendulum, an acrobot, a pendubot, or another chain with a passive joint. cart-pole and
rotary-pendulum name two files of the library, desktop plants with dry friction. MuJoCo simulates the plant, with
encoders and torques that act one sample late. The exploration needs no model and records only q and the commanded
torques. Models: identified (rigid bodies, linear in their parameters), delan (a structured deep Lagrangian network with
friction), known (the file's bodies and friction), analytic (the same without friction). Simulated trials choose all
gains, and a Kalman filter estimates the states.

The run folder gets data.npz, the model, law.json, metrics.json, config.json, and a figure of the runs.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

from dln_jax.options import Drawn, Folder, Unstated, choice


@dataclass(frozen=True)
class Arguments(Folder, Drawn):
    """Plant, model, and where the results go."""

    plant: Annotated[str, choice(("rotary-pendulum", "cart-pole", "FILE"))] = "rotary-pendulum"
    """The plant; furuta is another name of the rotary pendulum. FILE is the path of an MJCF or URDF file."""
    actuated: Unstated[str] = None
    """Joints with a motor, comma-separated names or numbers from 0 (default: those with an actuator or a
    transmission)."""
    control: Unstated[float] = None
    """Largest force of the motors, N m or N (default: as stated in the file)."""
    model: Literal["identified", "delan", "known", "analytic"] = "identified"
    """Model for the design of the controller."""
    estimator: Literal["extended", "unscented", "differences"] = "extended"
    """Source of the states: an extended or unscented Kalman filter, or differences of the encoder readings."""
    recover: Literal["swing-up", "plans"] = "swing-up"
    """How to recover from a push: swing up again, or replan on the way."""
    push: float = 0.0
    """Jump of the passive joints' velocities in the middle of every run, rad/s."""
    seconds_of_data: float = 30.0
    """Duration of the motion to learn from, at least 12 s, including an episode for validation."""
    starts: int = 100
    """Number of starts near hanging at rest."""
    seed: int = 0
    """Seed for the exploration, the network's initial parameters, the starts and the noise."""


def main(options: Arguments) -> None:
    """Explores the plant, learns the model, swings up and writes the run folder; a refused law exits with status 1."""
    from dln_jax.commands.learned_plants import swing_up

    swing_up(options)
