"""Options that commands share: presets and files of settings, and those that methods bring.

Settings come from a preset, over it a file (--config), and over both the options by name. The first
two are read before the others, for they set their defaults. Nothing here imports JAX.
"""

import argparse
import dataclasses
import functools
import re
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from dreamer_jax import config as configs
from dreamer_jax.config import Config
from dreamer_jax.ranges import setting
from experiments import methods
from experiments.methods import Method
from experiments.thesis import grid

Preset = Literal["thesis", "cpu", "demo", "debug"]
DEFAULT_PRESET: Preset = "cpu"

Devices = int | Literal["all"]
"""The option --devices."""

_NUMBER = re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$")

ConfigFile = Annotated[Path | None, tyro.conf.arg(name="config")]
"""The option --config."""


@dataclasses.dataclass(frozen=True)
class Simulators:
    """Where tasks are simulated."""

    workers: int | None = setting(None, 1, 10_000)
    """Simulator processes; by default one per core."""
    simulator_timeout: float = setting(300.0, 0, 1e7, above=True)
    """Seconds after which a simulator that does not answer is taken for stuck; a run that trains is
    saved and ended then."""


@dataclasses.dataclass(frozen=True)
class AtOnce:
    """How many members an update maps at once. It changes no result but by rounding."""

    mapping: Literal["auto", "vmap", "chunks"] = "auto"
    """How members of a population are mapped in an update; auto: as many at once as a device has
    memory for, one after the other on a CPU."""
    mapping_chunk: int = setting(1, 1, 10**6)
    """Members in a chunk."""


class Compared(str):
    """The name of a method that tables may show beside their own."""


# What a command line chooses from is looked up when it is read.
CONSTRUCTORS = tyro.constructors.ConstructorRegistry()
"""How options of our own types are made from words."""


@CONSTRUCTORS.primitive_rule
def _compared_rule(
    kind: tyro.constructors.PrimitiveTypeInfo,
) -> tyro.constructors.PrimitiveConstructorSpec[Compared] | None:
    if kind.type is not Compared:
        return None
    names = grid.may_be_compared()
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{{','.join(names)}}}",
        instance_from_str=lambda words: Compared(words[0]),
        is_instance=lambda value: value in names,
        str_from_instance=lambda value: [value],
        choices=names,
    )


@dataclasses.dataclass(frozen=True)
class Base:
    """What the other options' defaults are.

    Attributes:
      preset: its name.
      config: its settings, those of the file over them.
      file: the file of settings, if there is one.
      values: what else the file says, by name.
    """

    preset: Preset
    config: Config
    file: Path | None
    values: Mapping[str, Any]


def read_base(arguments: Sequence[str]) -> Base:
    """Reads --preset and --config alone from a command's arguments.

    Raises:
      ValueError: there is no such preset, no such file, or it is no file of settings.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--preset", nargs="?")
    parser.add_argument("--config", nargs="?", type=Path)
    try:
        found, _ = parser.parse_known_args(arguments)
    except argparse.ArgumentError as error:
        raise ValueError(str(error)) from error
    values = {} if found.config is None else read_settings(found.config)
    preset = found.preset or values.get("preset") or DEFAULT_PRESET
    config = _over(configs.preset(preset), values.get("config") or {}, found.config)
    return Base(typing.cast(Preset, preset), config, found.config, values)


def read_settings(path: Path) -> dict[str, Any]:
    """A file of settings: YAML or JSON, in the form of a run's own (run.json), or a part of it.

    Raises:
      ValueError: there is no such file, it is no mapping, or holds what is no setting of a run.
    """
    import yaml

    class Loader(yaml.SafeLoader):
        """YAML of version 1.2 in one point: 1e-4 is a number."""

    Loader.add_implicit_resolver("tag:yaml.org,2002:float", _NUMBER, list("-+.0123456789"))
    if not path.is_file():
        raise ValueError(f"there is no file of settings {path}")
    try:
        values = yaml.load(path.read_text(encoding="utf-8"), Loader)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is neither YAML nor JSON: {error}") from error
    if isinstance(values, dict) and "spec" in values:  # a whole run.json
        values = values["spec"]
    known = ("preset", "tasks", "seeds", "config", "method")
    if not isinstance(values, dict) or (set(values) - set(known)):
        raise ValueError(
            f"{path} is no file of settings: expected some of {', '.join(known)}, as the spec in a "
            "results folder's run.json is written"
        )
    return values


def _over(config: Config, groups: Mapping[str, Any], path: Path | None) -> Config:
    """Settings with those of a file in place of some."""
    whole = configs.to_dict(config)
    try:
        for group, settings in groups.items():
            whole[group] = {**whole.get(group, {}), **settings}
        return configs.from_dict(whole)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error


def sequence(values: Mapping[str, Any], name: str, default: Any) -> Any:
    """Several values of a file, one of which may stand without brackets."""
    if name not in values:
        return default
    return tuple(values[name]) if isinstance(values[name], list) else (values[name],)


# --- what methods bring ---------------------------------------------------------------------------


@functools.cache
def method_groups() -> dict[str, type]:
    """The settings of all methods as groups of options: those of the same methods are one group.

    Returns:
      Name of the group -> a dataclass with the settings as fields.
    """
    hints: dict[str, Any] = {}
    for method in methods.known().values():
        hints |= typing.get_type_hints(method)
    grouped: dict[tuple[str, ...], list[tuple[str, Any, Any]]] = {}
    for name, (field, owners) in methods.options().items():
        kind = tuple[Path, ...] if field.metadata["folder"] else hints[name]
        argument = tyro.conf.arg(name=field.metadata["option"], help=field.metadata["help"])
        entry = (name, Annotated[kind, argument], field.default)
        grouped.setdefault(owners, []).append(entry)
    found = {}
    # Widest first, from what most methods share to what one has of its own.
    for owners in sorted(grouped, key=lambda owners: (-len(owners), owners)):
        name = "_and_".join(owners).replace("-", "_")
        if owners == methods.options()["sources"][1]:
            name = "source"
        group = dataclasses.make_dataclass(name, grouped[owners], frozen=True)
        words = ", ".join(owners)
        group.__doc__ = f"Settings of --method {words}."
        found[name] = group
    return found


def method_summary() -> str:
    """What --method chooses from, for the help."""
    listed = "; ".join(f"{name}: {one.SUMMARY}" for name, one in methods.known().items())
    return f"How the source is used. {listed}. By default fractional with a source, else scratch."


def method_defaults(values: Mapping[str, Any]) -> tuple[str | None, dict[str, Any]]:
    """The method of a file of settings: its name and the groups of its settings.

    Raises:
      ValueError: the file names a setting that no method has.
    """
    given = dict(values.get("method") or {})
    name = given.pop("name", None)
    unknown = sorted(set(given) - set(methods.options()))
    if unknown:
        raise ValueError(f"unknown settings of a method: {', '.join(unknown)}")
    groups = {}
    for group, kind in method_groups().items():
        names = {field.name: field for field in dataclasses.fields(kind)}
        chosen = {key: _typed(key, value) for key, value in given.items() if key in names}
        groups[group] = kind(**chosen)
    return name, groups


def _typed(name: str, value: Any) -> Any:
    """A value of a file as the option's own: folders as paths, lists as tuples."""
    field, _ = methods.options()[name]
    if isinstance(field.default, tuple):
        value = tuple(value) if isinstance(value, list | tuple) else (value,)
        return tuple(map(Path, value)) if field.metadata["folder"] else value
    return value


def make_method(name: str | None, groups: Sequence[Any]) -> Method:
    """The method that options name.

    Raises:
      ValueError: see `methods.make`.
    """
    settings = {}
    for group in groups:
        for field in dataclasses.fields(group):
            value = getattr(group, field.name)
            if methods.options()[field.name][0].metadata["folder"]:
                value = tuple(map(str, value))
            settings[field.name] = value
    return methods.make(name, settings)
