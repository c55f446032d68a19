"""Which package may import which."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
LIBRARIES = ("dreamer_jax", "transfer", "envs")
ROOMS = ("methods", "runs", "thesis", "reports", "cli")
"""The rooms of experiments/: each may import those before it."""


def imported(path):
    """Full names of the modules that a file imports, wherever in it it does."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def packages(path):
    return {name.split(".")[0] for name in imported(path)}


@pytest.mark.parametrize("package", LIBRARIES)
def test_the_three_libraries_never_import_one_another(package):
    forbidden = set(LIBRARIES) - {package} | {"experiments"}
    files = sorted((ROOT / package).glob("**/*.py"))
    assert files
    found = {path.name: packages(path) & forbidden for path in files}
    assert {name: names for name, names in found.items() if names} == {}


def test_experiments_imports_all_three():
    names = set()
    for path in (ROOT / "experiments").glob("**/*.py"):
        names |= packages(path)
    assert names >= set(LIBRARIES)


@pytest.mark.parametrize("package", LIBRARIES)
def test_modules_of_a_library_do_not_import_one_another_in_a_circle(package):
    paths = [path for path in (ROOT / package).glob("**/*.py") if path.stem != "__init__"]
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in paths}
    graph = {}
    for name, path in names.items():
        found = [f"{each}." for each in imported(path)]
        graph[name] = {other for other in names if any(x.startswith(f"{other}.") for x in found)}
    assert any(graph.values())
    # Raises an error that names the circle; imports for type checks alone count too.
    tuple(TopologicalSorter(graph).static_order())


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_of_experiments_imports_only_those_below_it(room):
    allowed = ROOMS[: ROOMS.index(room) + 1]
    files = sorted((ROOT / "experiments" / room).glob("**/*.py"))
    assert files
    wrong = {
        path.name: name
        for path in files
        for name in imported(path)
        if name.startswith("experiments.") and name.split(".")[1] not in allowed
    }
    assert wrong == {}


def test_every_file_of_experiments_is_in_a_room():
    loose = {path.name for path in (ROOT / "experiments").glob("*.py")}
    assert loose == {"__init__.py", "__main__.py", "api.py"}
    folders = {path.parent.name for path in (ROOT / "experiments").glob("*/*.py")}
    assert folders == set(ROOMS)
