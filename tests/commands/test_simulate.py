"""Scenes of soft bodies do what they promise, their energies add up, and the command line."""

import os
import re
import sys

import jax
import numpy as np
import pytest
from calls import assert_refused, command, exit_status, json_of

import dln_jax.__main__ as main
from dln_jax.commands import simulate
from dln_jax.commands.simulations import motion
from dln_jax.metrics.soft_body_energies import motion_energies
from dln_jax.rollout import rollout
from dln_jax.softbody.examples import beam, drop, inputs
from dln_jax.softbody.mesh.shapes import beam as beam_mesh
from dln_jax.softbody.scene import potential
from dln_jax.softbody.step import make_step
from dln_jax.softbody.verdict import Info


def played(example, dt, steps):
    """x, v [T, n, dim] after each step, which have all converged."""
    init, step = make_step(example.scene, dt)
    params, driven = example.scene.params, inputs(example, dt, steps)

    def observe(state, info):
        return state.x, state.v, info.converged

    def motion():
        advance = lambda state, now: step(params, state, *now)  # noqa: E731
        return rollout(advance, init(v=example.v), driven, steps=steps, observe=observe)[1]

    x, v, converged = jax.jit(motion)()
    assert converged.all()
    return np.asarray(x), np.asarray(v)


def test_the_beam_falls_and_its_energies_add_up():
    example = beam(cells=1)
    scene = example.scene
    x, v = played(example, 0.05, 12)
    tip = int(np.argmax(scene.mesh.vertices[:, 0]))
    assert x[-1, tip, 1] < scene.mesh.vertices[tip, 1] - 0.2
    np.testing.assert_array_equal(x[-1][scene.held], scene.mesh.vertices[scene.held])

    energies = motion_energies(scene, scene.params, x, v)
    masses = np.asarray(scene.params.masses)
    kinetic = 0.5 * np.einsum("n,tnd->t", masses, v**2)
    assert energies["kinetic"] == pytest.approx(kinetic, rel=1e-12)
    stored = [float(potential(scene, x[i], scene.params)) for i in (0, -1)]
    assert energies["total"][[0, -1]] == pytest.approx(kinetic[[0, -1]] + stored, rel=1e-12)
    assert energies["gravity"] == pytest.approx(9.81 * x[:, :, 1] @ masses, rel=1e-12)
    assert (np.diff(energies["total"]) < 0).all()  # The implicit step damps.


def test_the_disc_bounces_and_hardly_sinks_in():
    example = drop(cells=2)
    x, v = played(example, 0.01, 75)
    lowest = x[:, :, 1].min(axis=1)
    assert example.scene.mesh.vertices[:, 1].min() == pytest.approx(1.0)
    assert -0.01 < lowest.min() < 0.0
    assert lowest[-1] > 0.02 and v[:, :, 1].mean(axis=1).max() > 1.0


def test_steps_that_went_wrong_are_not_silent():
    ones, second = np.ones(3), np.array([False, True, False])
    x = np.zeros((4, 3, 2))
    x[3, 0, 0] = np.nan
    good = {"energy_growth": -ones, "energy_at_hand": ones, "diverged": ones < 0, "least_J": ones}
    for changes, line in (
        ({}, "not finite from t = 3 s"),
        ({"converged": ~second}, "1 of 3 steps did not converge, the first at t = 2 s"),
        (
            {"converged": ~second, "diverged": second},
            "1 of 3 steps diverged: they created energy",
        ),
        ({"least_J": ones - 2 * second}, "1 of 3 steps turned elements inside out, the first at t = 2 s"),
        ({"overlaps": 2 * second}, "components overlap in 1 of 3 steps (up to 2 pairs), first at t = 2 s"),
    ):
        overlaps = changes.pop("overlaps", None)
        info = Info(ones, ones, **{"converged": ones > 0, **good, **changes})
        seen = motion.SimulatedMotion(np.arange(4.0), x, np.zeros_like(x), info, 1.0, 1.0, overlaps)
        said = "\n".join(motion.warnings(seen))
        assert line in said and "not finite" in said
        assert len(re.findall("did not converge|diverged|inside out|overlap", said)) == ("not finite" not in line)


def test_the_script_takes_a_mesh_of_ones_own(tmp_path, capsys):
    mesh = beam_mesh(2.0, 1.0, 2, 1)
    # Clockwise, and one more triangle on an edge that two share already.
    elements = np.concatenate([mesh.elements[:, ::-1], [[0, 3, 4]]])
    right = np.flatnonzero(mesh.vertices[:, 0] == 2.0)
    np.savez(tmp_path / "mesh.npz", vertices=mesh.vertices, elements=elements, held=right)
    options = "--scene beam --dt 0.05 --seconds 0.2 --youngs-modulus 1e5 --precision f32 --mesh"
    run = tmp_path / "run"
    command(simulate, options, tmp_path / "mesh.npz", "--out", run)
    metrics, report = (json_of(run / f"{name}.json") for name in ("metrics", "report"))
    assert metrics["steps"] == 4 and metrics["steps_not_converged"] == 0 and 0 < metrics["smallest_volume_ratio"] < 1
    assert report["conditions"]["dtype"] == "float32"
    assert {row["quantity"]: row["value"] for row in report["rows"]} == metrics
    assert {"energy.png", "moments.png", "motion.gif"} <= {path.name for path in run.iterdir()}
    shown = capsys.readouterr().out
    assert "steps per second" in shown and "warning" not in shown
    assert "beam: 6 vertices, 5 elements in 1 component, 2 x 1 m, 8 unknowns" in shown
    assert "of 5 elements were inverted and have been turned" in shown and "elements overlap at" in shown


def test_components_and_size_are_printed_and_suspicious_meshes_are_warned_of(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(motion, "run_motion", lambda *_: sys.exit(1))
    mesh = beam_mesh(30.0, 10.0, 2, 1)
    # Corners near each other, not at the same position: merging by position alone cannot find them.
    triangle = np.array([[0.0, 0.0], [0.01, 0.0], [0.0, 0.01]])
    loose = np.concatenate([triangle + np.array([0.011 * i, 0.0]) for i in range(4)])
    for vertices, elements, lines in (
        (
            np.concatenate([mesh.vertices, mesh.vertices + np.array([0.0, 20.0])]),
            np.concatenate([mesh.elements, mesh.elements + 6]),
            ["2 components, 30 x 30 m", "warning: 2 parts share no vertex", "the body is 30 m long", "--scale 0.001"],
        ),
        (
            loose,
            np.arange(12).reshape(4, 3),
            ["4 components, 0.043 x 0.01 m", "no two elements share a vertex"],
        ),
    ):
        path, out = tmp_path / "mesh.npz", tmp_path / str(len(elements))
        np.savez(path, vertices=vertices, elements=elements, held=[0, 1])
        assert exit_status(simulate, "--scene beam --mesh", path, "--out", out) == 1
        shown = capsys.readouterr().out
        assert all(line in shown for line in lines) and ("--scale" in shown) == (vertices is not loose)


def test_mistakes_are_one_line_and_leave_nothing_behind(tmp_path, capsys):
    out = tmp_path / "run"
    rows = {
        "--dt -0.1": "dt is -0.1",
        "--dt 0.1 --seconds 0.01": "--seconds is 0.01 and --dt 0.1",
        "--poisson-ratio 0.6": "poisson_ratio is 0.6",
        "--scene nonsense": "--scene is 'nonsense'; choose from beam, ",
        "--scene creature --mesh absent.npz": "the creature scene has no --mesh",
        "--cells 0": "number of cells along x is 0",
        "--order 3": "order is 3; expected 1",
        "--mixed": "--mixed needs --order 2",
        "--scene slope --contact": "has no --contact",
        "--scene creature --order 2": "the creature scene has no --order",
        "--mesh absent.npz": "absent.npz: no such file",
    }
    assert_refused(capsys, simulate, rows.items(), out=out)
    mesh, path = beam_mesh(1.0, 1.0, 1, 1), tmp_path / "mesh.npz"
    for held, row in (
        ([0.5], ["held is float64 of shape [1]"]),
        ([9], ["held names vertex 9"]),
        (np.arange(4), ["held"]),
        ([-1], ["held"]),
        ([0], ["--scene drop --contact --integrator midpoint", "use BACKWARD_EULER, BDF2"]),
        ([0], ["--cells 2", "--cells sets the scene's own mesh"]),
    ):
        np.savez(path, vertices=mesh.vertices, elements=mesh.elements, held=held)
        assert_refused(capsys, simulate, [row], "--mesh", path, out=out)


def test_commands_factorise_on_one_thread_unless_told(monkeypatch):
    """Threads that wait for each other burn the processor; SciPy reads the variable when it is first imported."""
    monkeypatch.setattr(sys, "argv", ["simulate"])
    monkeypatch.setattr(main.importlib, "import_module", lambda name: sys.exit(os.environ["OPENBLAS_NUM_THREADS"]))
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "3")
    for expected in "31":
        with pytest.raises(SystemExit, match=expected):
            main.command("simulate", "")
        monkeypatch.delenv("OPENBLAS_NUM_THREADS")


def test_blocks_that_fall_on_each_other_stay_apart(tmp_path):
    """One block above another, 0.15 m apart."""
    block = beam_mesh(1.0, 0.3, 4, 2)
    vertices = np.concatenate([block.vertices, block.vertices + np.array([0.3, 0.45])])
    elements = np.concatenate([block.elements, block.elements + len(block.vertices)])
    np.savez(tmp_path / "two.npz", vertices=vertices, elements=elements)
    options = "--scene drop --contact --youngs-modulus 1e5 --seconds 0.5 --no-figures"
    command(simulate, options, "--mesh", tmp_path / "two.npz", "--out", tmp_path / "run")
    numbers = json_of(tmp_path / "run/metrics.json")
    # Their surfaces act on each other within 15 mm, a tenth of the shortest edge.
    assert numbers["steps_not_converged"] == 0 and 0 < numbers["least_distance_of_surfaces"] < 0.0149
