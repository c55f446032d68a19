"""Hooks of mkdocs: a page for each module of the packages, made of its docstrings."""

from pathlib import Path

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parent.parent
PACKAGES = ("transfer", "dreamer_jax", "envs", "experiments")


def modules(package):
    """Names of the modules of a package that have something public, the package itself first."""
    for path in sorted((ROOT / package).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        if path.name == "__init__.py":
            if path.parent == ROOT / package:
                yield package
        elif not path.name.startswith("_"):
            yield ".".join(parts)


def on_config(config):
    pages = [
        {package: [f"reference/{name}.md" for name in modules(package)]} for package in PACKAGES
    ]
    config.nav.append({"Reference": pages})
    return config


def on_files(files: Files, config):
    for package in PACKAGES:
        for name in modules(package):
            text = f"# {name.removeprefix(f'{package}.')}\n\n::: {name}\n"
            files.append(File.generated(config, f"reference/{name}.md", content=text))
    return files
