"""Imports point down the floors of the architecture page, and folders on one floor do not know each other."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FLOORS = {
    "types": -3,  # symbols: everyone may read them
    "interrupts": -3,
    "time_limit": -3,
    "files": -2,
    "sizes": -2,
    "precision": -2,
    "compilation": -2,
    "scale": 0,  # devices and processes
    "rollout": 1,  # many steps of anything
    "nn": 1,
    "solvers": 1,
    "mechanics": 2,
    "softbody": 2,
    "scenes": 3,
    "models": 3,
    "data": 3,
    "zoo": 4,
    "datasets": 4,
    "learning": 5,
    "metrics": 6,
    "deploy": 6,
    "control": 4,
    "excitation": 6,
    "identification": 6,
    "figures": 7,
    "locomotion": 8,
    "command_line": 8,
    "runs": 10,
    "sweeps": 11,
    "commands": 12,
    "__main__": 13,
    "__init__": 13,  # the public names, gathered from every floor
}
MODULES = sorted((ROOT / "dln_jax").rglob("*.py"))


def room_of(parts: tuple[str, ...]) -> str:
    return parts[0].removesuffix(".py")


def imported_rooms(source: str) -> set[str]:
    """Rooms of dln_jax that a module imports, anywhere in its text."""
    rooms = set()
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
                rooms.add("scripts")
            elif parts[0] == "dln_jax":
                rooms.add(parts[1] if len(parts) > 1 and parts[1] in FLOORS else "__init__")
    return rooms


def faults(room: str, source: str) -> list[str]:
    return [
        other
        for other in imported_rooms(source)
        if other != room and (other not in FLOORS or FLOORS[other] >= FLOORS[room])
    ]


@pytest.mark.parametrize("module", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_point_down(module):
    room = room_of(module.relative_to(ROOT / "dln_jax").parts)
    assert room in FLOORS, f"{room} has no floor"
    assert not faults(room, module.read_text())


def test_an_arrow_that_points_up_is_seen():
    assert faults("mechanics", "from dln_jax.models import delan") == ["models"]
    assert faults("scenes", "import dln_jax.models.lagrangian") == ["models"]
    assert faults("nn", "import scripts.train_delan") == ["scripts"]
    assert not faults("models", "from dln_jax.mechanics import natural")
