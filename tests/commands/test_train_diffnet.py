"""The command line of differential networks end to end on a tiny budget: what it writes, and what it refuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import assert_refused, command, exit_status, json_of, refused

from dln_jax import load
from dln_jax.commands import train_diffnet
from dln_jax.commands.functions.networks import verdict_of
from dln_jax.data import functions
from dln_jax.learning import functions as regression
from dln_jax.learning.engine import checkpoint
from dln_jax.learning.engine import fit as engine_fit
from dln_jax.learning.functions import Network
from dln_jax.metrics.verdict import LEVELS

SMALL = "--samples 200 --width 4"
ADAM = f"{SMALL} --optimizer adam --epochs 2 --batch 64"
FILES = {".lock", "config.json", "metrics.json", "model.json", "model.safetensors"}


def names_in(folder):
    """Without the checkpoints."""
    return {path.name for path in folder.iterdir() if not path.name.startswith("checkpoint")}


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def own_file(path, **changes):
    """Sixty samples of a smooth function of three inputs and two outputs, of very different sizes."""
    units = np.array([1.0, 100.0, 0.01])
    x = np.random.default_rng(0).uniform(-1, 1, (60, 3)) * units

    def function(x):
        u = x / units
        return jnp.array([jnp.sin(u[0]) + u[1] * u[2], 1e3 * jnp.exp(u[1])])

    functions = {"y": function, "dy": jax.jacfwd(function), "d2y": jax.hessian(function)}
    data = {"x": x, **{key: np.asarray(jax.vmap(each)(x)) for key, each in functions.items()}, **changes}
    np.savez(path, **{key: value for key, value in data.items() if value is not None})
    return data


def test_a_default_run_writes_all_its_files_and_the_model_can_be_loaded(workplace, capsys):
    command(train_diffnet, SMALL, "--steps 4")
    folder = workplace / "runs/train_diffnet-1"
    assert names_in(folder) == FILES | {"curves.png", "training.png"}
    metrics, config = (json_of(folder / f"{name}.json") for name in ("metrics", "config"))
    assert metrics["parameters"] == 4 + 4 + 4 + 1
    assert {"value_mse", "gradient_mse", "train_seconds", "one_step_p50_us"} <= set(metrics)
    assert (config["function"], config["optimizer"]) == ("sin", "gauss-newton")
    assert (config["chosen"]["width"], config["chosen"]["precision"]) == (4, "f64")
    assert metrics["verdict"] == LEVELS.index(config["chosen"]["verdict"]["level"])
    grid = functions.published_grid("sin")
    answers = jax.vmap(load(folder).derivatives)(grid.x)
    np.testing.assert_allclose(np.mean((answers.hessian - grid.d2y) ** 2), metrics["hessian_mse"], rtol=1e-6)
    out = capsys.readouterr().out
    assert "value, gradient; gauss-newton, f64" in out and "almost everywhere" not in out and "verdict: " in out
    assert "already contains a run" in refused(capsys, train_diffnet, SMALL, "--out", folder)


def test_verdict_counts_every_component_of_what_was_fitted():
    x = np.random.default_rng(0).normal(size=(200, 2))
    true = functions.FunctionSamples(x, x**2, np.einsum("ni,ij->nij", 2 * x, np.eye(2)))
    dead = true._replace(dy=true.dy * np.array([[1, 1], [1, 0]]))
    values, gradients = (Network(width=4, depth=1, loss=loss) for loss in ("type2", "type1"))
    assert verdict_of(gradients, true, true).level == verdict_of(values, dead, true).level == "good"
    verdict = verdict_of(gradients, dead, true)
    assert verdict.level == "refused" and "the gradient of component 4 is predicted no better" in verdict.reason


def test_adam_on_two_inputs_with_an_ensemble_shows_its_spread_outside_the_data(workplace, monkeypatch):
    monkeypatch.setitem(functions.PUBLISHED, "cos_sin", (functions.cosine_sine, 2, 9))
    command(train_diffnet, ADAM, "--function cos_sin --ensemble 3 --out run")
    assert names_in(workplace / "run") == FILES | {"ensemble.png", "heat_maps.png", "surfaces.png", "training.png"}
    metrics = json_of(workplace / "run/metrics.json")
    assert metrics["parameters"] == 3 * (8 + 4 + 16 + 4 + 4 + 1)
    assert metrics["spread_inside"] > 0 and metrics["spread_outside"] > 0
    assert load("run").derivatives(np.zeros(2)).value.dtype == jnp.float32


def test_a_file_of_ones_own_trains_in_standard_units_and_is_stored_in_its_own(workplace):
    data = own_file("mine.npz")
    command(train_diffnet, "--function mine.npz --activation tanh --width 6 --depth 1 --steps 30 --out run")
    assert names_in(workplace / "run") == FILES | {"parity.png", "training.png"}
    metrics = json_of(workplace / "run/metrics.json")
    assert metrics["value_mse"] < 1e-2 * data["y"].var(axis=0).sum()
    answers = jax.vmap(load("run").derivatives)(data["x"])
    assert answers.hessian.shape == (60, 2, 3, 3)
    units = data["x"].std(axis=0) / data["y"].std(axis=0)[:, None]
    assert np.sqrt(np.mean(((answers.jacobian - data["dy"]) * units) ** 2)) < 0.1


@pytest.mark.slow
def test_relu_is_told_that_its_hessian_is_useless(workplace, capsys):
    quick = "--loss type2 --no-figures"
    command(train_diffnet, ADAM, quick, "--activation relu --derivative 2 --out run")
    out = capsys.readouterr().out
    assert "Hessian is zero almost everywhere" in out and "teaches it nothing" in out
    assert names_in(workplace / "run") == FILES
    # The error of predicting zero: the mean of sin² over the grid.
    assert json_of(workplace / "run/metrics.json")["hessian_mse"] == pytest.approx(
        np.mean(functions.published_grid("sin").d2y ** 2)
    )


@pytest.mark.slow
def test_an_interrupted_run_resumes_bit_for_bit(workplace, monkeypatch, capsys):
    """Stopped after a few reports, and continued: the width is chosen again."""
    own_file("mine.npz")
    wanted = "--function mine.npz --loss type2 --depth 1 --steps 12 --no-figures"
    monkeypatch.setattr(regression, "WIDTHS", (2,))
    command(train_diffnet, wanted, "--out unbroken")
    store = checkpoint.store

    def store_and_die(*arguments):
        store(*arguments)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(engine_fit, "store", store_and_die)
        assert exit_status(train_diffnet, wanted, "--out broken") == 130
    assert not (workplace / "broken/model.json").exists()
    line = refused(capsys, train_diffnet, "--resume --out broken --seed 3")
    assert "started with seed = 0; leave --seed out" in line
    command(train_diffnet, "--resume --no-figures --out broken")
    ours, theirs = ((workplace / run / "model.safetensors").read_bytes() for run in ("broken", "unbroken"))
    assert ours == theirs


MISTAKES = {
    "--activation sigmoidal": "activation is 'sigmoidal'; choose one of relu",
    "--loss type3": "--loss is 'type3'; choose from type1, type2",
    "--width 0": "width is 0",
    "--ensemble 0": "members is 0",
    "--precision f32": "gauss-newton needs f64",
    "--batch -1": "--batch is an option of --optimizer adam",
    "--optimizer adam --steps 5": "--steps is an option of --optimizer gauss-newton",
    "--optimizer adam --learning-rate nan": "--learning-rate is nan",
    "--samples 5": "--samples is an option of --function sin and cos_sin",
    "--function none.npz": "no such file",
    "--function tan": "expected sin, cos_sin or an npz file",
}


def test_mistakes_are_one_line_and_leave_nothing_behind(workplace, capsys):
    out = workplace / "refused"
    for changes, *row in (
        ({"y": None}, "key 'y' is missing"),
        ({"dy": None}, "no dy; add it or choose type2"),
        ({"d2y": None}, "--derivative 2", "no d2y"),
        ({"dy": np.full((60, 2, 3), 1e200)}, "dy has numbers of up to"),
    ):
        own_file("wrong.npz", **changes)
        assert_refused(capsys, train_diffnet, [row], "--function wrong.npz", out=out)
    own_file("good.npz")
    assert_refused(capsys, train_diffnet, MISTAKES.items(), "--function good.npz", out=out)
