"""Imports point down the layers of the architecture page, and packages of one layer do not import each other."""

import ast
from pathlib import Path

ROOT = Path(__file__).parent.parent
LAYERS = {
    "errors": -4,
    "types": -3,  # symbols: everyone may read them
    "process": -3,
    "files": -2,
    "options": -2,
    "precision": -2,
    "scale": 0,
    "rollout": 1,  # many steps of anything
    "nn": 1,
    "solvers": 1,
    "mechanics": 2,
    "softbody": 2,
    "models": 3,
    "data": 3,
    "scenes": 4,  # with the data generated from them
    "control": 5,
    "zoo": 5.5,
    "learning": 6,
    "metrics": 7,
    "export": 7,
    "identification": 7,
    "learning.fits": 7.5,  # ways of fitting a log, which compare and identify
    "figures": 8,
    "locomotion": 9,
    "runs": 10,  # what commands share
    "commands": 13,
    "__main__": 14,
    "public": 14,  # the public names, gathered from every layer
    "__init__": 15,
}
MODULES = sorted((ROOT / "dln_jax").rglob("*.py"))


def package_of(parts):
    """The package that a module belongs to: the first name, or the first two where those have a layer of their own."""
    names = [part.removesuffix(".py") for part in parts]
    both = ".".join(names[:2])
    return both if both in LAYERS else names[0]


def imported_packages(source):
    """Packages of dln_jax that a module imports, anywhere in its text."""
    packages = set()
    for node in ast.walk(ast.parse(source)):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute, so that arrows can be read"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            parts = name.split(".")
            if parts[0] == "scripts":
                packages.add("scripts")
            elif parts[0] == "dln_jax":
                known = len(parts) > 1 and parts[1] in LAYERS
                packages.add(package_of(tuple(parts[1:])) if known else "__init__")
    return packages


def faults(package, source):
    return [
        other
        for other in imported_packages(source)
        if other != package and (other not in LAYERS or LAYERS[other] >= LAYERS[package])
    ]


def test_imports_point_down():
    packages = {module: package_of(module.relative_to(ROOT / "dln_jax").parts) for module in MODULES}
    assert set(packages.values()) <= set(LAYERS)
    upward = {str(module): faults(package, module.read_text()) for module, package in packages.items()}
    assert not {module: others for module, others in upward.items() if others}


def test_at_most_eighteen_packages():
    packages = [folder for folder in (ROOT / "dln_jax").iterdir() if (folder / "__init__.py").is_file()]
    assert 10 < len(packages) <= 18


def test_an_arrow_that_points_up_is_seen():
    assert faults("mechanics", "from dln_jax.models import delan") == ["models"]
    assert faults("models", "import dln_jax.scenes.pendulum") == ["scenes"]
    assert faults("nn", "import scripts.train_delan") == ["scripts"]
    assert not faults("models", "from dln_jax.mechanics import natural")
