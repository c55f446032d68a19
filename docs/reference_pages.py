"""Hooks of mkdocs: pages of modules, made of their docstrings, and pages that nothing names."""

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


def named(nav):
    """All pages that a navigation names."""
    for entry in nav.values() if isinstance(nav, dict) else nav:
        yield from [entry] if isinstance(entry, str) else named(entry)


def on_config(config):
    pages = [path.name for path in sorted((ROOT / "docs").glob("*.md"))]
    if others := [name for name in pages if name not in set(named(config.nav))]:
        config.nav.append({"More": others})
    reference = [
        {package: [f"reference/{name}.md" for name in modules(package)]} for package in PACKAGES
    ]
    config.nav.append({"Reference": reference})
    return config


def on_files(files: Files, config):
    for package in PACKAGES:
        for name in modules(package):
            text = f"# {name.removeprefix(f'{package}.')}\n\n::: {name}\n"
            files.append(File.generated(config, f"reference/{name}.md", content=text))
    return files
