"""The published biped and its policy (J. Rojas, algovivo), as a task and a policy of this package.

    change = clip(tanh(W2 relu(W1 ((x - x_c) Rᵀ, v Rᵀ) + b1) + b2), -0.3, 0.3)

x_c is the centre vertex, and the first row of R points from it to the forward vertex.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.locomotion.frames import vertex_frame
from dln_jax.locomotion.learning import Parameters, Policy
from dln_jax.locomotion.task import POSITION_UNIT, LocomotionTask, make_task
from dln_jax.locomotion.worlds import FLAT, Variation
from dln_jax.softbody.mesh.mesh import make_mesh
from dln_jax.softbody.mesh.shapes import Creature
from dln_jax.types import InputError

DISTANCE = 41.37
"""Body lengths in 2,000 steps from rest in its author's program."""
LAYERS = (f"policy_fc{i}_{part}" for i in (1, 2) for part in ("weight", "bias"))
NAMES = ("vertices", "triangles", "muscles", *LAYERS, "policy_center_vertex_id", "policy_forward_vertex_id")
KEYS = tuple(f"biped_{name}" for name in NAMES)
"""Arrays of the file."""


def published_biped(
    data: Mapping[str, np.ndarray], *, variation: Variation = FLAT
) -> tuple[LocomotionTask, Policy, Parameters]:
    """Returns task, policy and its parameters from the arrays `biped_vertices`, `biped_policy_fc1_weight` and so on.

    Raises:
        InputError: an array is missing.
    """
    if missing := [key for key in KEYS if key not in data]:
        raise InputError(f"{missing[0]} is missing; expected the published biped with its policy")
    vertices, triangles, muscles, *weights, centre, forward = (data[key] for key in KEYS)
    mesh = make_mesh(vertices, triangles)
    frame = vertex_frame(len(vertices), [int(centre), int(forward)])
    task = make_task(Creature("published-biped", mesh, muscles), frame=frame, variation=variation, clock_period=0.0)
    a = vertices[int(forward)] - vertices[int(centre)]
    a = a / np.linalg.norm(a)
    rest = (vertices - vertices[int(centre)]) @ np.array([[a[0], -a[1]], [a[1], a[0]]])
    count = rest.size

    def apply(parameters: Parameters, seen: jax.Array) -> jax.Array:
        w1, b1, w2, b2 = parameters
        x, v = seen[:count] * (POSITION_UNIT * task.length) + rest.ravel(), seen[count : 2 * count] * task.length
        return jnp.tanh(w2 @ jax.nn.relu(w1 @ jnp.concatenate([x, v]) + b1) + b2)

    parameters = tuple(jnp.asarray(weight) for weight in weights)
    return task, Policy(lambda _: parameters, apply), parameters
