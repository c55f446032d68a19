"""What is installed: the wheel holds the project, and works where the repository is not."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from zipfile import ZipFile

import pytest
import yaml

ROOT = Path(__file__).parent.parent
PACKAGES = ("dreamer_jax", "transfer", "envs", "experiments")
DEPENDENCIES = {"brax", "mujoco", "pybullet", "pybullet_envs_gymnasium"}

IMPORT_ALL = """
import importlib, importlib.resources, pkgutil, sys

site, packages, absent = sys.argv[1], {packages!r}, set({absent!r})
for package in packages:
    module = importlib.import_module(package)
    assert module.__file__.startswith(site), module.__file__
    for found in pkgutil.walk_packages(module.__path__, package + "."):
        if found.name.endswith("__main__"):
            continue
        try:
            importlib.import_module(found.name)
        except ModuleNotFoundError as error:
            assert error.name.partition(".")[0] in absent, error
        print(found.name)
"""


def ran(command, **options):
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, **options)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return done.stdout


def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def package_files():
    """All files in the packages' folders, by their paths in the repository."""
    paths = (path for package in PACKAGES for path in (ROOT / package).rglob("*"))
    files = (path.relative_to(ROOT).as_posix() for path in paths if path.is_file())
    return {name for name in files if "__pycache__" not in name}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Built from a copy, so that the build leaves nothing in the repository."""
    source = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "LICENSE", "README.md", "PACKAGE.md"):
        shutil.copy(ROOT / name, source)
    for name in package_files():
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, source / name)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "wheel", "--no-deps"]
    ran([*pip, "--no-build-isolation", "--wheel-dir", "made", "."], cwd=source)
    (made,) = (source / "made").glob("*.whl")
    return made


@pytest.fixture(scope="module")
def site(wheel, tmp_path_factory):
    """A folder that the wheel is installed into."""
    target = tmp_path_factory.mktemp("site")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--no-deps"]
    ran([*pip, "--no-index", "--target", str(target), str(wheel)])
    return target


def outside(site, *arguments):
    """What a Python prints that finds the project in `site` only."""
    environment = os.environ | {"PYTHONPATH": str(site), "PYTHONDONTWRITEBYTECODE": "1"}
    return ran([sys.executable, *arguments], cwd=site.parent, env=environment)


def test_the_wheel_holds_every_file_of_the_packages(wheel):
    shipped = {name for name in ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert shipped == package_files()
    assert {f"{package}/py.typed" for package in PACKAGES} <= shipped


def test_every_module_imports_from_the_installed_wheel(site):
    code = IMPORT_ALL.format(packages=PACKAGES, absent=sorted(DEPENDENCIES))
    modules = set(outside(site, "-c", code, str(site)).split())
    expected = {
        name.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
        for name in package_files()
        if name.endswith(".py") and not name.endswith("__main__.py")
    }
    assert modules == expected - set(PACKAGES)


def test_the_installed_command_works(site):
    assert "train" in outside(site, str(site / "bin" / "dreamer-transfer"), "--help")


def test_the_page_for_the_index_shows_nothing_that_lies_in_the_repository():
    assert project()["readme"] == "PACKAGE.md"
    targets = re.findall(r"\]\(([^)]*)\)", (ROOT / "PACKAGE.md").read_text())
    assert [target for target in targets if not target.startswith("https://")] == []


def test_the_page_for_the_index_names_every_extra_for_users():
    named = set(re.findall(r"^\| `(\w+)` ", (ROOT / "PACKAGE.md").read_text(), re.MULTILINE))
    assert named == set(project()["optional-dependencies"]) - {"dev", "docs"}


def test_the_code_on_the_page_for_the_index_runs(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "PACKAGE.md").read_text(), re.DOTALL)
    names = {}
    exec(code, names)
    assert (names["params"]["out"]["kernel"] == 0.2).all()
    assert "fraction" in capsys.readouterr().out


def test_the_citation_is_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == project()["version"]
    assert citation["license"] == project()["license"]
    assert [author["name"] for author in citation["authors"]] == [
        author["name"] for author in project()["authors"]
    ]
