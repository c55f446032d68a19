"""The transfer library by itself: nothing of the project, and only its three dependencies."""

import re
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

ROOT = Path(__file__).parent.parent

# Only what these three need, and they themselves, can be imported.
ALONE = """
import sys

allowed = set({allowed!r})

class Gate:
    # Finds only what is allowed.

    def __init__(self, finder):
        self.finder = finder

    def __getattr__(self, name):
        return getattr(self.finder, name)

    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top in allowed or top in sys.stdlib_module_names or top.startswith("_"):
            return self.finder.find_spec(name, path, target)

sys.meta_path[:] = map(Gate, sys.meta_path)
import jax.numpy as jnp, numpy as np, optax, pathlib, tempfile
import transfer
from transfer import ltc, meta_model, recipes

tree = {{"a": jnp.ones(2), "b": jnp.zeros(2)}}
plan = transfer.Plan((transfer.Rule("a", "fraction", {{"omega": 0.5}}),), default="keep")
folder = pathlib.Path(tempfile.mkdtemp())
for suffix in ("npz", "safetensors"):
    transfer.save(folder / f"x.{{suffix}}", tree)
    new, report = transfer.apply(plan, tree, transfer.load(folder / f"x.{{suffix}}"))
    assert (new["a"] == 1.5).all(), report
transfer.write_plan(plan, folder / "plan.json")
assert transfer.read_plan(folder / "plan.json") == plan
transfer.freeze(optax.adam(0.1), "a").init(tree)
for call in (lambda: transfer.write_plan(plan, folder / "plan.yaml"),
             lambda: transfer.save(folder / "checkpoint", tree)):
    try:
        call()
    except ImportError as error:
        assert "pip install 'dreamer-transfer[files]'" in str(error), error
    else:
        raise AssertionError("an extra was imported")
print("alone")
"""


def needed(names):
    """The packages that some need, themselves included, by the names they are imported by."""
    found, waiting = set(), list(names)
    while waiting:
        name = re.match(r"[\w.-]+", waiting.pop())[0].lower().replace("-", "_")
        if name in found:
            continue
        found.add(name)
        try:
            lines = requires(name) or []
        except PackageNotFoundError:
            continue
        waiting += [line for line in lines if "extra ==" not in line]
    return {"absl" if name == "absl_py" else name for name in found}


def dependencies():
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_core_is_three_packages():
    names = {re.match(r"[\w-]+", line)[0] for line in dependencies()["dependencies"]}
    assert names == {"jax", "numpy", "optax"}


def test_the_library_works_where_only_its_dependencies_are():
    allowed = sorted(needed(dependencies()["dependencies"]) | {"transfer"})
    assert not {"flax", "yaml", "orbax", "matplotlib", "gymnasium", "chex"} & set(allowed)
    found = subprocess.run(
        [sys.executable, "-c", ALONE.format(allowed=allowed)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert found.stdout == "alone\n", found.stderr[-2000:]


def test_the_library_says_that_it_is_typed():
    assert (ROOT / "transfer" / "py.typed").exists()
    assert "py.typed" in (ROOT / "pyproject.toml").read_text()
