"""Solvers of optimistix and diffrax, built on Equinox's own primitives, give in C what they give in JAX."""

import diffrax
import equinox
import equinox.internal
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import optimistix
import pytest
from comparison import in_c, in_jax
from compilers import needs_compiler
from sanitized import in_sanitized_c

pytestmark = needs_compiler
RANDOM = np.random.default_rng(3)
STATES = [tuple(row) for row in RANDOM.uniform(-1, 1, size=(20, 1, 2))]


def implicit(y, a):
    """Two equations without a known closed form."""
    return jnp.stack([y[0] ** 3 + 2 * y[0] + y[1] - a[0], 3 * y[1] + jnp.sin(y[0]) - a[1]])


def root(a, steps=30):
    solver = optimistix.Newton(rtol=1e-13, atol=1e-13)
    return optimistix.root_find(implicit, solver, jnp.zeros(2), a, max_steps=steps).value


def check_agreement(function, folder):
    """The results in C, under sanitizers, after comparison with JAX; one result."""
    functions, states = {"f": (function, STATES[0])}, {"f": STATES}
    ours = np.concatenate(in_sanitized_c(functions, states, folder)["f"])
    (theirs,) = in_jax(functions, states)["f"]
    assert np.isfinite(theirs).all()
    np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)
    return ours


@pytest.mark.slow
def test_newton_of_optimistix_and_the_derivative_of_its_root(tmp_path):
    ours = check_agreement(lambda a: jnp.concatenate([root(a)[None], jax.jacobian(root)(a)]), tmp_path)
    ours = ours.reshape(len(STATES), 3, 2)
    residual, slope = jax.vmap(lambda y, a: (implicit(y, a), jax.jacobian(implicit)(y, a)))(
        ours[:, 0], np.stack([state for (state,) in STATES])
    )
    assert np.abs(residual).max() < 1e-12
    np.testing.assert_allclose(slope @ ours[:, 1:], np.broadcast_to(np.eye(2), (len(STATES), 2, 2)), atol=1e-12)


@pytest.mark.slow
def test_tsit5_of_diffrax_with_constant_steps(tmp_path):
    """Half a second in 25 steps, and where it is at five times in between."""

    def rollout(x):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, length: jnp.stack([y[1], -9.81 / length * jnp.sin(y[0])])),
            diffrax.Tsit5(),
            *(0.0, 0.5, 0.02, x, 0.7),
            saveat=diffrax.SaveAt(t1=True, ts=jnp.linspace(0.05, 0.45, 5)),
            stepsize_controller=diffrax.ConstantStepSize(),
            max_steps=32,
        ).ys

    ours = check_agreement(rollout, tmp_path)
    energy = 0.5 * (0.7 * ours[..., 1]) ** 2 - 9.81 * 0.7 * np.cos(ours[..., 0])
    np.testing.assert_allclose(energy - energy[:, :1], 0, atol=1e-6)


def bounded_loop(kind):
    def body(carry):
        k, y, kept = carry
        return k + 1, jnp.cos(y), kept.at[k].set(y[0])

    options = {"kind": kind, "max_steps": 6, "checkpoints": 3, "buffers": lambda carry: carry[2]}
    return lambda x: equinox.internal.while_loop(lambda carry: carry[0] < 4, body, (0, x, jnp.zeros(5)), **options)[1:]


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
    states = dict.fromkeys(functions, STATES[:5])
    got = in_c(functions, states, tmp_path)
    # Not mapped: what is noinline, or asks about a whole batch, is not the same inside of vmap.
    every = jax.jit(lambda x: [function(x) for function in EQUINOX.values()])
    rows = [map(jax.tree.leaves, every(*state)) for state in STATES[:5]]
    for ours, theirs, case in zip(got.values(), zip(*rows, strict=True), EQUINOX, strict=True):
        for mine, wanted in zip(ours, map(np.stack, zip(*theirs, strict=True)), strict=True):
            np.testing.assert_allclose(mine, wanted, rtol=1e-13, atol=1e-13, err_msg=case)


def test_an_error_is_nan(tmp_path):
    """As it is in JAX by EQX_ON_ERROR=nan; C raises none."""

    def checked(x):
        whole = equinox.error_if(jnp.arange(2), x[0] > 2, "too large")
        return equinox.error_if(x, x[0] > 2, "too large"), whole

    functions = {"checked": (checked, STATES[0]), "unsolved": (lambda a: root(a, steps=2), STATES[0])}
    states = {"checked": [(np.array([1.0, 5.0]),), (np.array([3.0, 5.0]),)], "unsolved": STATES[:2]}
    got = in_c(functions, states, tmp_path)
    numbers, whole = got["checked"]
    np.testing.assert_array_equal(numbers, [[1.0, 5.0], [np.nan, np.nan]])
    np.testing.assert_array_equal(whole, [[0, 1], [2**63 - 1, 2**63 - 1]])
    assert np.isnan(got["unsolved"][0]).all()


BODY = '<body pos="0 0 -.3"><joint axis="{}" damping=".1"/><geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03"/>'
ARM = f"<mujoco><worldbody>{''.join(map(BODY.format, ('0 1 0', '1 0 0', '0 1 0')))}{3 * '</body>'}</worldbody></mujoco>"


def test_step_of_mjx(tmp_path):
    mjx = pytest.importorskip("mujoco.mjx", reason="mjx is the package mujoco-mjx")
    model = mjx.put_model(mujoco.MjModel.from_xml_string(ARM))
    data = mjx.make_data(model)

    def step(q, qd, tau):
        after = mjx.step(model, data.replace(qpos=q, qvel=qd, qfrc_applied=tau))
        return after.qpos, after.qvel

    states = {"step": [tuple(state) for state in RANDOM.normal(size=(20, 3, 3))]}
    functions = {"step": (step, states["step"][0])}
    ours, theirs = in_c(functions, states, tmp_path)["step"], in_jax(functions, states)["step"]
    for got, expected in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-14 * np.abs(expected).max())
