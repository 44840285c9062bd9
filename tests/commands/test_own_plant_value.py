"""A value function of a file's plant: trained, interrupted, resumed, loaded, judged; and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import assert_refused, command, exit_status, json_of, one_line
from numpy.testing import assert_allclose, assert_array_equal

from dln_jax.commands import train_value
from dln_jax.commands.values import plants
from dln_jax.commands.values import run as training
from dln_jax.commands.values.evaluation import value_error, verdict_of
from dln_jax.control.closed_loop import ClosedLoopRun
from dln_jax.control.optimal.action_costs import quadratic
from dln_jax.control.optimal.fitted import Iteration
from dln_jax.control.optimal.problem import ControlProblem, from_field, rates
from dln_jax.control.optimal.value_networks import value_network
from dln_jax.zoo.run import load, save
from dln_jax.zoo.value_functions import ValueRun, plant_of_model

ROD = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0" damping="0.05"/>
<inertial mass="1" pos="0 0 0.5" diaginertia="0.08333 0.08333 0.001"/></body></worldbody>
<actuator><motor joint="hinge" ctrlrange="-2.5 2.5" ctrllimited="true"/></actuator></mujoco>"""
TINY = "--width 3 --depth 1 --iterations 2 --starts 3 --no-figures"


@pytest.fixture
def rod(tmp_path):
    (tmp_path / "rod.xml").write_text(ROD)
    return tmp_path / "rod.xml"


@pytest.fixture
def brief(monkeypatch):
    """Shortens the iterations."""
    # Programs that earlier tests traced in float64 may hold 64-bit indices.
    jax.clear_caches()
    short = {"starts": 16, "steps": 4, "seconds": 0.2, "batch": 16}
    monkeypatch.setattr("dln_jax.control.optimal.own_plants.Iteration", lambda **sizes: Iteration(**sizes | short))


def test_an_interrupted_run_resumes_to_the_same_bits_and_comes_back(tmp_path, capsys, rod, brief, monkeypatch):
    arguments = ("--plant", rod, TINY, "--robust 0.1")
    command(train_value, *arguments, "--out", tmp_path / "whole")
    output = capsys.readouterr().out
    assert "hinge 2.5 N m" in output and "box, half widths: hinge 3.14 rad" in output and "verdict: " in output
    store = training.store

    def stop(*state):
        store(*state)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(training, "store", stop)
        assert exit_status(train_value, *arguments, "--out", tmp_path / "cut") == 130
    command(train_value, "--out", tmp_path / "cut", "--resume")
    whole, cut = (load(tmp_path / name).value for name in ("whole", "cut"))
    x = jnp.array([1.0, -0.5])
    assert_array_equal(whole.law(x), cut.law(x))
    one, other = (json_of(tmp_path / name / "metrics.json")["heavy_weak_return_mean"] for name in ("whole", "cut"))
    assert one == other
    # The model in the folder is the file's plant.
    expected = (2.0 + 9.81 / 2 * np.sin(1.0) - 0.05 * -0.5) / (0.25 + 0.08333)
    assert_allclose(rates(whole.problem)(x, jnp.array([2.0])), [-0.5, expected], rtol=1e-6)


def test_the_verdict_counts_the_starts_that_end_up():
    numbers = {"down_up_share": 1.0, "uniform_up_share": 1.0}
    # The value of the worst case exceeds the cost.
    robust = {"heavy_weak_up_share": 1.0, "light_strong_up_share": 1.0}
    for level, changes in (
        ("good", {}),
        ("good", {"value_error": 0.01}),
        ("good", {"value_error": 0.3, **robust}),
        ("doubtful", {"uniform_up_share": 0.99}),
        ("doubtful", {**robust, "heavy_weak_up_share": 0.9}),
        ("doubtful", {"value_error": 0.3}),
        ("refused", {"down_up_share": 0.89}),
        ("refused", {"down_up_share": np.nan}),
    ):
        assert verdict_of({**numbers, **changes}, 100).level == level, changes
    assert "V differs from the cost of its law by 30.0%" in verdict_of({**numbers, "value_error": 0.3}, 100).reason


def test_error_of_a_known_value_is_that_of_the_quadrature():
    """dx/dt = u with cost (x² + u²)/2, discount 1.5: V = p x² / 2 with p² + 1.5 p = 1, so p = 1/2 and u = -x/2."""
    problem = ControlProblem(
        lambda x: jnp.zeros(1),
        lambda x: jnp.ones((1, 1)),
        lambda x: x[0] ** 2 / 2,
        quadratic(1.0),
        1.5,
        [-1.0],
        [1.0],
        ("prismatic",),
        [0.0],
    )
    value = lambda scale, x: (scale * x[0] ** 2 / 4, scale * x / 2)  # noqa: E731
    network = value_network(problem)._replace(value_and_gradient=value)
    t = np.tile(np.linspace(0, 10, 10001), (4, 1))
    x = np.linspace(0.3, 0.9, 4)[:, None, None] * np.exp(-t / 2)[..., None]
    runs = ClosedLoopRun(t, x, -x[:, :-1] / 2, x)
    for scale in (1.0, 1.2):
        of = ValueRun("integrator", problem, None, network, scale)
        assert value_error(of, runs, np.zeros(4)) == pytest.approx(scale - 1, abs=2e-3)
    assert np.isnan(value_error(of, runs, np.full(4, np.inf)))


def test_mistakes_are_one_line_and_leave_nothing(tmp_path, capsys, rod):
    rows = {
        "--actuated ²": "there is no joint '\u00b2'",
        "--actuated elbow": "there is no joint 'elbow'",
        "--control -1": "expected finite positive numbers",
        "--control 1 --goal 0.6": "the limits are",
        "--positions 1:0": "expected LOW:HIGH or free",
        "--positions free,free": "2 ranges; the plant has 1 joints",
        "--positions -1:1": "is outside",
        "--weights 1": "expected 2 positive numbers",
        "--robust 1.5": "--robust is 1.5",
        "--run /nowhere": "no such file",
    }
    assert_refused(capsys, train_value, rows.items(), "--plant", rod, out=tmp_path / "run")


def test_the_model_in_a_folder_is_the_same_plant_as_its_file(tmp_path, rod):
    known, layout, _ = plants.of_file(rod)
    save(tmp_path, known.description, known.parameters)
    stored, stored_layout, _ = plants.of_run(tmp_path, control=2.5)
    problem, other = plants.problem_of(known, layout), plants.problem_of(stored, stored_layout)
    for name in ("goal", "hanging", "scale", "weights", "box", "limits"):
        assert_allclose(getattr(other, name), getattr(problem, name), atol=1e-5)
    x, u = jnp.array([0.7, 1.0]), jnp.array([1.5])
    plant = plant_of_model(known.model, known.parameters, problem)
    from_folder = plant_of_model(stored.model, stored.parameters, other)
    assert_allclose(*[rates(one)(x, u) for one in (from_folder, plant)], rtol=1e-9)
    # A body of 1.2 times the mass is accelerated by the motor 1 / 1.2 as much.
    _, altered = plants.uncertain_numbers(known, problem)
    _, actuation = from_field(altered(jnp.array([1.2, 1.0])), 1)
    ratio = actuation(x)[1, 0] / plant.actuation(x)[1, 0]
    assert float(ratio) == pytest.approx(1 / 1.2, rel=1e-9)
    with one_line("states no limits of the motors"):
        plants.of_run(tmp_path)
