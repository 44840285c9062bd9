"""Mass matrices that are none: indefinite, singular or not finite Hessians must be reported."""

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.mechanics import lagrangian
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.metrics.definiteness import definiteness
from dln_jax.models.black_box import make_black_box_lagrangian
from dln_jax.studies.case import Findings
from dln_jax.studies.report import expect
from dln_jax.studies.stability.random_models import random_parameters
from dln_jax.types import Needs


def indefinite_hessians() -> Findings:
    """Mass matrices that are none: known ones, and those of a black-box network that nothing has trained."""

    def known(q, qd):
        """M = diag(1, q_0): definite, singular and indefinite where q_0 is positive, 0 and negative."""
        return 0.5 * (qd[0] ** 2 + q[0] * qd[1] ** 2)

    q = np.array([[1.0, 0.0], [0.5, 0.0], [0.0, 0.0], [-1.0, 0.0], [np.nan, 0.0]])
    report = definiteness(lagrangian.dynamics(LagrangianSystem(known)), q, np.zeros_like(q))
    clean = definiteness(lagrangian.dynamics(LagrangianSystem(known)), q[:4], np.zeros((4, 2)))
    needs = Needs(joints=("revolute", "revolute"))
    model = make_black_box_lagrangian(needs, width=16, dtype=jnp.float64)
    system = dynamics(model.energies(random_parameters(model)))
    states = [np.random.default_rng(0).uniform(-1, 1, (64, 2)) * size for size in (np.pi, 2.0)]
    network = definiteness(system, *states)
    mass = np.asarray(jax.jit(jax.vmap(system.mass_matrix))(*states))
    # Sylvester: a symmetric 2x2 matrix is definite if its first entry and its determinant are positive.
    definite = (mass[:, 0, 0] > 0) & (mass[:, 0, 0] * mass[:, 1, 1] - mass[:, 0, 1] ** 2 > 0)
    share = float(np.mean(~definite))
    case, untrained, eps = "indefinite/known-matrices", "indefinite/black-box-delan", float(np.finfo(np.float64).eps)
    unreported = float(np.isfinite(report.largest_condition_number)) + float(not np.isnan(report.smallest_eigenvalue))
    three = "M = diag(1, q_0) at q_0 = 1, 0.5, 0, -1, NaN: three of five are reported"
    least = "the smallest eigenvalue of the finite ones is -1, to rounding"
    none = "a singular M has an infinite condition number, and one that is NaN a NaN eigenvalue"
    negative = "an untrained black-box Lagrangian has negative kinetic energy in some direction, and it is reported"
    sylvester, error = f"the share reported is that by Sylvester's criterion, {share:.2f}", "share_wrongly_reported"
    rows = [
        expect(case, error, three, abs(report.share_not_definite - 0.6), 0.0, reference=0.0),
        expect(case, "smallest_eigenvalue_error", least, abs(clean.smallest_eigenvalue + 1.0), 2 * eps),
        expect(case, "singular_or_nan_unreported", none, unreported, 0.0),
        expect(untrained, "smallest_eigenvalue", negative, network.smallest_eigenvalue, 0.0, "kg m^2"),
        expect(untrained, error, sylvester, abs(network.share_not_definite - share), 0.0),
    ]
    return Findings(rows)
