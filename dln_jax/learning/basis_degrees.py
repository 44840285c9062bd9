"""How much of a trigonometric basis data ask for: a degree for each joint, chosen by validation trajectories.

One degree for all joints grows until it no longer helps (`learning.growth`); where that is more than 1, each joint in
turn is given the smallest degree that is not significantly worse. A joint that neither turns the mass matrix nor lifts
a weight, such as an arm's first vertical axis, ends at degree 0, which divides the basis by 2 n + 1.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.data.schema import Trajectories
from dln_jax.learning.growth import Trial, grow, significantly_better
from dln_jax.learning.linear import LinearFit, fit_linear
from dln_jax.learning.objectives import TORQUE, arrays, residuals
from dln_jax.models.trigonometric import make_trigonometric
from dln_jax.solvers.normal_equations import count
from dln_jax.types import Needs

LARGEST_DEGREE = 4
"""That is tried."""
MOST_PARAMETERS = 1_500
"""Of a basis that is tried; a fit takes some N d P² operations."""
ROUNDING = 1e-10
"""Error, relative to the torque, below which no basis is better than another."""

Degrees = tuple[int, ...]


def choose_degrees(needs: Needs, train: Trajectories, validation: Trajectories) -> tuple[Trial, list[Trial]]:
    """The chosen degrees, one for each joint, and all that were tried.

    Of a `Trial`, the candidate is the degrees, the outcome the `LinearFit` in float64, and the errors are those of the
    torque, squared, at the validation samples. Degrees above 1 are tried while they have no more parameters than the
    training data have equations, and than `MOST_PARAMETERS`.

    Raises:
        InputError: the basis of degree 1 is too large, or what `fit_linear` refuses.
    """
    d = needs.degrees_of_freedom
    target = ROUNDING**2 * float(np.mean(np.sum(validation.tau**2, axis=1)))

    def fit(degrees: Degrees) -> tuple[LinearFit, Float[np.ndarray, " N"]]:
        with jax.enable_x64(True):
            model = make_trigonometric(needs, degree=degrees)
            found = fit_linear(model, train)
            judge = jax.jit(lambda parameters, batch: residuals(TORQUE, model.energies(parameters), batch))
            errors = judge(found.parameters, arrays(TORQUE, validation, jnp.float64))
        return found, np.sum(np.asarray(errors) ** 2, axis=1)

    def fits(degree: int) -> bool:
        size = count(jax.eval_shape(make_trigonometric(needs, degree=degree).init, jax.random.key(0)))
        return size <= min(MOST_PARAMETERS, train.tau.size)

    most = next((n - 1 for n in range(2, LARGEST_DEGREE + 1) if not fits(n)), LARGEST_DEGREE)
    chosen, trials = grow([(n,) * d for n in range(1, most + 1)], fit, patience=1, target=target)
    for joint in range(d if chosen.candidate[0] > 1 else 0):
        while chosen.candidate[joint] > 0:
            fewer = tuple(n - (place == joint) for place, n in enumerate(chosen.candidate))
            trials.append(Trial(fewer, *fit(fewer)))
            if trials[-1].validation > target and significantly_better(chosen.errors, trials[-1].errors):
                break
            chosen = trials[-1]
    return chosen, trials
