"""Scenes of soft bodies do what they promise, their energies add up, and the command line."""

import functools
import math
import os
import sys

import jax
import numpy as np
import pytest
from calls import assert_refused, command, json_of

import dln_jax.__main__ as main
from dln_jax.cli.commands import simulate
from dln_jax.figures.soft_bodies import Moments, energies_against_time, moments_figure
from dln_jax.metrics.soft_body_energies import motion_energies
from dln_jax.rollout import rollout
from dln_jax.softbody.driven import drive, driven_step
from dln_jax.softbody.examples import beam, creature, drop, slope, twist
from dln_jax.softbody.integrators import BACKWARD_EULER, BDF2
from dln_jax.softbody.mesh.shapes import beam as beam_mesh
from dln_jax.softbody.mesh.shapes import body_length, crawler
from dln_jax.softbody.scene import potential, with_parameters
from dln_jax.softbody.verdict import Info
from dln_jax.training.simulation_results import SimulatedMotion, finite_moments, warn
from dln_jax.types import InputError


def played(example, dt, steps, integrator=BACKWARD_EULER):
    """x, v [T, n, dim] after each step; params -> motion, for one compilation."""
    init, step = driven_step(example, dt, integrator)
    driven = drive(example, dt, steps)

    def observe(state, info):
        return state.x, state.v, info.converged

    def run(params):
        return rollout(functools.partial(step, params), init(), driven, observe=observe)[1]

    return jax.jit(run)


@pytest.mark.slow
def test_the_beam_falls_and_its_energies_add_up():
    example = beam(cells=1)
    scene = example.scene
    x, v, converged = played(example, 0.05, 12)(scene.params)
    tip = int(np.argmax(scene.mesh.vertices[:, 0]))
    assert bool(converged.all()) and float(x[-1, tip, 1]) < scene.mesh.vertices[tip, 1] - 0.2
    assert np.array_equal(x[-1][scene.held], scene.mesh.vertices[scene.held])
    assert set(scene.held.tolist()) == set(np.flatnonzero(scene.mesh.vertices[:, 0] == 0).tolist())

    energies = motion_energies(scene, scene.params, x, v)
    masses = np.asarray(scene.params.masses)
    kinetic = [0.5 * float((masses * (np.asarray(each) ** 2).sum(axis=1)).sum()) for each in v]
    stored = np.array([float(potential(scene, x[i], scene.params)) for i in (0, -1)])
    assert energies["kinetic"] == pytest.approx(np.array(kinetic), rel=1e-12)
    assert energies["total"][[0, -1]] == pytest.approx(np.array(kinetic)[[0, -1]] + stored, rel=1e-12)
    assert energies["gravity"] == pytest.approx(9.81 * np.asarray(x)[:, :, 1] @ masses, rel=1e-12)
    assert (np.diff(energies["total"]) < 0).all()  # What the implicit step damps.


@pytest.mark.slow
def test_the_ends_of_the_bar_are_turned_by_the_angle():
    example = twist(cells=1, turns=1.5)
    rest, held = example.scene.mesh.vertices, example.scene.held
    assert driven_step(example, 0.25).init().previous is None
    x, _, converged = played(example, 0.25, 8, BDF2)(example.scene.params)
    last = np.asarray(x)[-1]
    assert bool(converged.all())
    # Half of 4 s: each end has turned by 3/8 of a turn about y, against each other.
    arms, turned = ((p[held][:, 0] - 0.5) + 1j * (p[held][:, 2] - 0.5) for p in (rest, last))
    upper = rest[held, 1] > 4.0
    assert turned / arms == pytest.approx(np.exp(1j * np.where(upper, -1, 1) * 0.75 * np.pi), abs=1e-12)
    assert last[held, 1] == pytest.approx(rest[held, 1], abs=1e-12)
    # What lies between follows: it has not stayed, and the middle, by symmetry, is not turned on the average.
    free = np.setdiff1d(np.arange(len(rest)), held)
    assert np.abs(last[free] - rest[free]).max() > 0.3


@pytest.mark.slow
def test_the_block_slides_as_friction_says_or_sticks():
    example = slope(cells=1)
    run = played(example, 0.02, 40)
    along = np.array([1.0, 0.5]) / math.hypot(1.0, 0.5)
    speeds = {}
    for friction in (0.3, 0.6):
        _, v, converged = run(with_parameters(example.scene.params, ground={"friction": friction}))
        assert bool(converged.all())
        speeds[friction] = -(np.asarray(v).mean(axis=1) @ along)
    acceleration = (speeds[0.3][-1] - speeds[0.3][19]) / 0.4
    assert acceleration == pytest.approx(9.81 * (0.5 - 0.3) / math.hypot(1.0, 0.5), rel=0.02)
    assert abs(speeds[0.6][20:]).max() < 2e-3  # The threshold of smooth friction is 1e-3 m/s.


def test_the_disc_bounces_and_hardly_sinks_in():
    example = drop(cells=2)
    x, v, converged = played(example, 0.01, 75)(example.scene.params)
    lowest = np.asarray(x)[:, :, 1].min(axis=1)
    assert bool(converged.all())
    assert example.scene.mesh.vertices[:, 1].min() == pytest.approx(1.0)
    assert -0.01 < lowest.min() < 0.0
    assert lowest[-1] > 0.02 and np.asarray(v)[:, :, 1].mean(axis=1).max() > 1.0
    other, again = drop(cells=2, seed=1), drop(cells=2)
    assert np.array_equal(example.v, again.v) and not np.array_equal(example.v, other.v)


def test_a_box_in_space_is_turned_and_not_deformed():
    mesh, upright = drop(dimension=3, cells=1).scene.mesh, drop(dimension=3, cells=1, seed=3).scene.mesh
    sizes = [np.linalg.norm(m.vertices[:, None] - m.vertices[None], axis=-1) for m in (mesh, upright)]
    assert sizes[0] == pytest.approx(sizes[1], abs=1e-12)
    assert mesh.vertices[:, 2].min() == pytest.approx(np.ptp(mesh.vertices[:, 2]))


@pytest.mark.slow
def test_the_creature_crawls():
    example = creature()
    x, _, converged = played(example, example.dt, 60)(example.scene.params)
    means = np.asarray(x)[:, :, 0].mean(axis=1)
    assert bool(converged.all())
    assert means[-1] - means[0] > 0.1 * body_length(crawler())
    control = drive(example, example.dt, 60).control
    assert 0.25 <= float(control.min()) < 0.35 and 0.95 < float(control.max()) <= 1.0


def test_figures_show_energies_from_the_start_and_refuse_what_does_not_fit():
    mesh = beam_mesh(1.0, 1.0, 1, 1)
    t = np.array([0.0, 1.0])
    with pytest.raises(InputError, match="has positions"):
        moments_figure([Moments("a", mesh, np.zeros((2, 3, 2)), t)])
    with pytest.raises(InputError, match="no panel"):
        moments_figure([])
    energies = {"kinetic": np.zeros(2), "gravity": np.array([5e3, 2e3]), "total": np.array([5e3, 2e3])}
    axis = energies_against_time(t, energies, taken="lost", title="").axes[0]
    total = next(line for line in axis.get_lines() if line.get_label() == "total")
    assert total.get_ydata() == pytest.approx([0.0, -3.0]) and axis.get_ylabel() == "energy, kJ"


def test_steps_that_did_not_converge_are_not_silent(capsys):
    converged = np.array([True, False, True])
    numbers = np.ones(3)
    x = np.zeros((4, 3, 2))
    x[3, 0, 0] = np.nan
    calm = np.zeros(3, bool)
    info = Info(
        numbers, numbers, converged, energy_growth=-numbers, energy_at_hand=numbers, diverged=calm, least_J=numbers
    )
    motion = SimulatedMotion(np.arange(4.0), x, np.zeros_like(x), info, 1.0, 1.0)
    assert finite_moments(motion) == 3
    warn(motion)
    said = capsys.readouterr().out
    assert "diverged" not in said and "inside out" not in said
    warn(motion._replace(info=info._replace(diverged=np.array([False, True, True]), least_J=np.array([1, -0.1, 1]))))
    worse = capsys.readouterr().out
    assert "2 of 3 steps diverged: they created energy, the first at t = 2 s" in worse
    warn(motion._replace(info=info._replace(overlaps=np.array([0, 2, 1]))))
    assert "components overlap in 2 of 3 steps (up to 2 pairs), first at t = 2 s" in capsys.readouterr().out
    assert "1 of 3 steps turned elements inside out, the first at t = 2 s" in worse and "did not converge" not in worse
    assert "1 of 3 steps did not converge, the first at t = 2 s" in said and "not finite from t = 3 s" in said


@pytest.mark.slow
def test_the_script_takes_a_mesh_of_ones_own(tmp_path, capsys):
    mesh = beam_mesh(2.0, 1.0, 2, 1)
    right = np.flatnonzero(mesh.vertices[:, 0] == 2.0)
    # Clockwise, and one more triangle on an edge that two share already.
    elements = np.concatenate([mesh.elements[:, ::-1], [[0, 3, 4]]])
    np.savez(tmp_path / "mesh.npz", vertices=mesh.vertices, elements=elements, held=right)
    options = ("--mesh", tmp_path / "mesh.npz", "--dt", "0.05", "--seconds", "0.2", "--youngs-modulus", "1e5")
    command(simulate, "--scene beam", *options, "--precision f32 --out", tmp_path / "run")
    metrics = json_of(tmp_path / "run" / "metrics.json")
    config = json_of(tmp_path / "run" / "config.json")
    report = json_of(tmp_path / "run" / "report.json")
    assert metrics["steps"] == 4 and metrics["steps_not_converged"] == 0 and metrics["newton_iterations_max"] >= 1
    assert 0 < metrics["smallest_volume_ratio"] < 1 and metrics["steps_per_second"] > 0
    assert config["scene"] == "beam" and config["dt"] == 0.05 and config["precision"] == "f32"
    assert {row["quantity"]: row["value"] for row in report["rows"]} == metrics
    assert report["conditions"]["dtype"] == "float32"
    for name in ("energy.png", "moments.png"):
        assert (tmp_path / "run" / name).read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "run" / "motion.gif").read_bytes().startswith(b"GIF")
    shown = capsys.readouterr().out
    assert "steps per second" in shown and "warning" not in shown
    assert "beam: 6 vertices, 5 elements in 1 component, 2 x 1 m, 8 unknowns" in shown
    assert "of 5 elements were inverted and have been turned" in shown and "elements overlap at" in shown


def test_components_and_size_are_printed_and_millimetres_are_warned_of(tmp_path, capsys):
    mesh = beam_mesh(30.0, 10.0, 2, 1)
    vertices = np.concatenate([mesh.vertices, mesh.vertices + np.array([0.0, 20.0])])
    np.savez(tmp_path / "mesh.npz", vertices=vertices, elements=np.concatenate([mesh.elements, mesh.elements + 6]))
    options = ("--mesh", tmp_path / "mesh.npz", "--seconds", "0.02", "--dt", "0.01", "--no-figures")
    command(simulate, "--scene beam", *options, "--out", tmp_path / "run")
    shown = capsys.readouterr().out
    assert "12 vertices, 8 elements in 2 components, 30 x 30 m" in shown
    assert "warning: 2 parts share no vertex" in shown
    assert "warning: the body is 30 m long" in shown and "add --scale 0.001" in shown


def test_a_mesh_of_loose_elements_is_warned_of(tmp_path, capsys):
    # Corners near each other, not at the same position: merging by position alone cannot find them.
    triangle = np.array([[0.0, 0.0], [0.01, 0.0], [0.0, 0.01]])
    vertices = np.concatenate([triangle + np.array([0.011 * i, 0.0]) for i in range(4)])
    np.savez(tmp_path / "mesh.npz", vertices=vertices, elements=np.arange(12).reshape(4, 3), held=[0, 1])
    options = ("--mesh", tmp_path / "mesh.npz", "--seconds", "0.02", "--dt", "0.01", "--no-figures")
    command(simulate, "--scene beam", *options, "--out", tmp_path / "run")
    shown = capsys.readouterr().out
    assert "4 elements in 4 components, 0.043 x 0.01 m" in shown and "--scale" not in shown
    assert "warning: no two elements share a vertex" in shown


def test_mistakes_are_one_line_and_leave_nothing_behind(tmp_path, capsys):
    absent = tmp_path / "absent.npz"
    rows = [
        ("--dt -0.1", "dt is -0.1"),
        ("--dt 0.1 --seconds 0.01", "--seconds is 0.01 and --dt 0.1"),
        ("--poisson-ratio 0.6", "poisson_ratio is 0.6"),
        ("--scene nonsense", "--scene is 'nonsense'; choose from beam, "),
        ("--material wood", "--material is 'wood'"),
        ("--precision half", "--precision is 'half'"),
        ("--integrator leapfrog", "--integrator is 'leapfrog'"),
        ("--friction 0.1", "the beam scene has no --friction"),
        ("--scene creature --mesh", absent, "the creature scene has no --mesh"),
        ("--seed -1", "seed is -1"),
        ("--dimension 4", "dimension is 4"),
        ("--cells 0", "number of cells along x is 0"),
        ("--order 3", "order is 3; expected 1"),
        ("--mixed", "--mixed needs --order 2"),
        ("--scene creature --order 2", "the creature scene has no --order"),
        ("--mesh", absent, "absent.npz: no such file"),
    ]
    assert_refused(capsys, simulate, rows, out=tmp_path / "run")


def test_wrong_meshes_are_one_line_and_leave_nothing_behind(tmp_path, capsys):
    mesh, path, out = beam_mesh(1.0, 1.0, 1, 1), tmp_path / "mesh.npz", tmp_path / "run"
    good = {"vertices": mesh.vertices, "elements": mesh.elements}
    held = [np.arange(4), [-1], np.zeros(0, int), [[0]]]
    for arrays, words in (
        ({"vertices": mesh.vertices}, "'elements' is missing (found: vertices)"),
        ({**good, "elements": mesh.elements[[0, 0]]}, "element 1 is a duplicate"),
        ({**good, "held": [0.5]}, "held is float64 of shape [1]"),
        ({**good, "held": [9]}, "held names vertex 9"),
        *(({**good, "held": vertices}, "held") for vertices in held),
    ):
        np.savez(path, **arrays)
        assert_refused(capsys, simulate, [(words,)], "--mesh", path, out=out)
    np.savez(path, **good)
    assert_refused(capsys, simulate, [("--cells 2", "--cells sets the scene's own mesh")], "--mesh", path, out=out)


@pytest.mark.parametrize("stated", [None, "3"])
def test_commands_factorise_on_one_thread_unless_told(stated, monkeypatch):
    """Threads that wait for each other burn the processor; SciPy reads the variable when it is first imported."""
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", stated or "")
    if stated is None:
        monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    monkeypatch.setattr(sys, "argv", ["simulate"])
    monkeypatch.setattr(main.importlib, "import_module", lambda name: sys.exit(os.environ["OPENBLAS_NUM_THREADS"]))
    with pytest.raises(SystemExit, match=stated or "1"):
        main.command("simulate", "")
