"""Grids: the jobs that a text means, and refusals before anything starts."""

from calls import one_line

from dln_jax.commands import check_data, train_delan, train_locomotion
from dln_jax.commands.sweeps.jobs import grid_of, jobs_of, pairs


def test_grid_of_a_text():
    for text, grid in {
        "seed=0:3": {"seed": ("0", "1", "2")},
        "seed=4:-1:-2": {"seed": ("4", "2", "0")},
        "width=8,16 --learning-rate=1e-3": {"width": ("8", "16"), "learning_rate": ("1e-3",)},
        "width=2:4,16": {"width": ("2", "3", "16")},
        "data='a b.npz',c:d.npz": {"data": ("a b.npz", "c:d.npz")},
        "needs='{\"gravity\": false}'": {"needs": ('{"gravity": false}',)},
    }.items():
        assert grid_of(text) == grid
    assert pairs("--fixed", "test=e,q,v steps=5") == {"test": "e,q,v", "steps": "5"}


MISTAKES = {
    "": "names no option",
    "width": "expected NAME=VALUE",
    "width=": "expected NAME=VALUE",
    "width=8,,16": "empty value",
    "width='8": "close the quotes",
    "seed=3:3": "empty range",
    "seed=0:3:0": "step 0",
    "seed=1,0:3": "seed has 1 twice",
    "seed=1 width=8 seed=2": "names 'seed' twice",
    "seed=0:10001": "at most 10,000",
    "seed=0:101 width=0:100": "10,100 combinations",
    "widht=8": r"no option widht; did you mean width\?",
    "width=8.5": "--width must be a whole number",
    "optimizer=adam learning_rate=0.1:0.5": "--learning-rate must be a number",
    "activation=tanh,relu": "--activation is 'relu'",
    "figures=maybe": "expected yes or no",
    "data=nowhere.npz": "data=nowhere.npz: no such file",
    "out=a,b": "gets from the sweep",
    "depth=1": "in both --grid and --fixed",
}


def test_mistakes_are_refused_before_anything_starts(tmp_path):
    for text, message in MISTAKES.items():
        with one_line(message):
            jobs_of("train_delan", train_delan.Arguments, grid_of(text), {"depth": "2"}, tmp_path)
        assert not list(tmp_path.iterdir())


def test_jobs_are_command_lines(tmp_path):
    (tmp_path / "a.npz").touch()
    grid = grid_of(f"width=8,16 data={tmp_path}/a.npz")
    fixed = pairs("--fixed", "uncertainty=no compilation-cache=yes test=e,q")
    first, second = jobs_of("train_delan", train_delan.Arguments, grid, fixed, tmp_path)
    common = ("--no-uncertainty", "--compilation-cache", "--test=e,q", "--processes=1")
    assert first.arguments == (*common, "--width=8", f"--data={tmp_path}/a.npz")
    assert second.values == {"width": "16", "data": f"{tmp_path}/a.npz"} and second.folder == tmp_path / "jobs/0001"
    assert first.resumes
    jobs = jobs_of("train_delan", train_delan.Arguments, grid_of("width=2,4 seed=0:3"), {}, tmp_path)
    assert [tuple(job.values.values()) for job in jobs] == [(w, s) for w in "24" for s in "012"]


def test_a_job_continues_where_its_command_can(tmp_path):
    jobs = jobs_of("train_locomotion", train_locomotion.Arguments, grid_of("creature=crawler,biped"), {}, tmp_path)
    assert [job.resumes for job in jobs] == [True, True]
    # An option without a default accompanies every option that is checked.
    (tmp_path / "log.npz").touch()
    fixed = {"data": str(tmp_path / "log.npz")}
    (job, _) = jobs_of("check_data", check_data.Arguments, grid_of("figures=no,yes"), fixed, tmp_path)
    assert not job.resumes and job.arguments[-1] == "--no-figures"
