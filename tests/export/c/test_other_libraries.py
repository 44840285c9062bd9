"""Solvers of optimistix and diffrax, built on Equinox's own primitives, give in C what they give in JAX."""

import shutil

import diffrax
import equinox
import equinox.internal
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
from comparison import in_c, in_jax
from sanitized import in_sanitized_c

pytestmark = pytest.mark.skipif(
    not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="there is no C compiler on the PATH"
)
RANDOM = np.random.default_rng(3)
STATES = [tuple(row) for row in RANDOM.uniform(-1, 1, size=(20, 1, 2))]


def implicit(y, a):
    """Two equations without a known closed form."""
    return jnp.stack([y[0] ** 3 + 2 * y[0] + y[1] - a[0], 3 * y[1] + jnp.sin(y[0]) - a[1]])


def root(a):
    solver = optimistix.Newton(rtol=1e-13, atol=1e-13)
    return optimistix.root_find(implicit, solver, jnp.zeros(2), a, max_steps=30).value


def pendulum(t, y, length):
    return jnp.stack([y[1], -9.81 / length * jnp.sin(y[0])])


def rollout(x):
    """Half a second in 25 steps, and where it is at five times in between."""
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(pendulum), diffrax.Tsit5(), 0.0, 0.5, 0.02, x, 0.7,
        saveat=diffrax.SaveAt(t1=True, ts=jnp.linspace(0.05, 0.45, 5)),
        stepsize_controller=diffrax.ConstantStepSize(), max_steps=32,
    )  # fmt: skip
    return solution.ys


def check_agreement(function, folder):
    """The results in C, under sanitizers, after comparison with JAX; one result."""
    functions, states = {"f": (function, STATES[0])}, {"f": STATES}
    ours = np.concatenate(in_sanitized_c(functions, states, folder)["f"])
    (theirs,) = in_jax(functions, states)["f"]
    assert np.isfinite(theirs).all()
    np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)
    return ours


def test_newton_of_optimistix(tmp_path):
    roots = check_agreement(root, tmp_path)
    left = jax.vmap(implicit)(roots, np.stack([state for (state,) in STATES]))
    assert np.abs(left).max() < 1e-12


def test_derivative_of_a_root(tmp_path):
    check_agreement(jax.jacobian(root), tmp_path)


@pytest.mark.slow
def test_tsit5_of_diffrax_with_constant_steps(tmp_path):
    ours = check_agreement(rollout, tmp_path)
    energy = 0.5 * (0.7 * ours[..., 1]) ** 2 - 9.81 * 0.7 * np.cos(ours[..., 0])
    np.testing.assert_allclose(energy - energy[:, :1], 0, atol=1e-6)


def bounded_loop(kind):
    def function(x):
        def body(carry):
            k, y, kept = carry
            return k + 1, jnp.cos(y), kept.at[k].set(y[0])

        loop = equinox.internal.while_loop
        return loop(
            lambda carry: carry[0] < 4, body, (0, x, jnp.zeros(5)),
            kind=kind, max_steps=6, checkpoints=3, buffers=lambda carry: carry[2],
        )[1:]  # fmt: skip

    return function


EQUINOX = {
    "noinline": lambda x: equinox.internal.noinline(lambda y: jnp.sin(y) * 3)(x) + 1,
    "noinline in a loop": lambda x: jax.lax.scan(
        lambda c, row: (equinox.internal.noinline(jnp.sin)(c) + row, c), x[0], x
    ),
    "unvmap": lambda x: (
        equinox.internal.unvmap_any(x > 0.5),
        equinox.internal.unvmap_all(x > -1),
        equinox.internal.unvmap_max((5 * x).astype(int)),
    ),
    "identities": lambda x: (
        equinox.internal.nondifferentiable_backward(x),
        equinox.internal.nontraceable(2.0 * x.shape[0]) + x,
        equinox.internal.nonbatchable(jnp.arange(2)) + x,
        equinox.internal.nondifferentiable(x),
    ),
    **{f"{kind} loop": bounded_loop(kind) for kind in ("lax", "bounded", "checkpointed")},
    "filter_jit": lambda x: equinox.filter_jit(equinox.filter_grad(lambda y: jnp.sum(jnp.sin(y) ** 2)))(x),
    "error_if": lambda x: equinox.error_if(x, jnp.any(x > 2), "too large"),
}


def test_primitives_of_equinox(tmp_path):
    functions = {f"case_{place}": (function, STATES[0]) for place, function in enumerate(EQUINOX.values())}
    states = dict.fromkeys(functions, STATES)
    got = in_c(functions, states, tmp_path)
    for name, case in zip(functions, EQUINOX, strict=True):
        # Not mapped: what is noinline, or asks about a whole batch, is not the same inside of vmap.
        jitted = jax.jit(functions[name][0])
        rows = [jax.tree.leaves(jitted(*state)) for state in STATES]
        for ours, theirs in zip(got[name], map(np.stack, zip(*rows, strict=True)), strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-13, atol=1e-13, err_msg=case)


def test_an_error_is_nan(tmp_path):
    """As it is in JAX by EQX_ON_ERROR=nan; C raises none."""

    def checked(x):
        whole = equinox.error_if(jnp.arange(2), x[0] > 2, "too large")
        return equinox.error_if(x, x[0] > 2, "too large"), whole

    def unsolved(a):
        solver = optimistix.Newton(rtol=1e-13, atol=1e-13)
        return optimistix.root_find(implicit, solver, jnp.zeros(2), a, max_steps=2).value

    functions = {"checked": (checked, STATES[0]), "unsolved": (unsolved, STATES[0])}
    states = {"checked": [(np.array([1.0, 5.0]),), (np.array([3.0, 5.0]),)], "unsolved": STATES[:2]}
    got = in_c(functions, states, tmp_path)
    numbers, whole = got["checked"]
    np.testing.assert_array_equal(numbers, [[1.0, 5.0], [np.nan, np.nan]])
    np.testing.assert_array_equal(whole, [[0, 1], [2**63 - 1, 2**63 - 1]])
    assert np.isnan(got["unsolved"][0]).all()
