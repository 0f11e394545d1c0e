"""Settings of a command: defaults, overridden by a TOML file (--config), overridden by options."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

from nerif.cli.arguments import flag_value, present_name, values_of
from nerif.cli.help import help_text
from nerif.common.conventions import InputError
from nerif.common.files import local_path, read_toml
from nerif.common.settings import MISSING, check_settings, merge, options

__all__ = ["COMMAND_LINE_ONLY", "Settings", "command", "compute", "read_settings", "setting_of"]

IGNORED_TABLES = ("about",)  # results in run.toml
COMMAND_LINE_ONLY = ("allowed_host", "cluster", "dashboard", "force", "host", "root_path")
"""Options that run code of another machine or a shell (cluster), open the app or a port to others, or overwrite files:
a file, which may come from another person, cannot set them."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of every command."""

    brief: ClassVar[bool] = False  # help shows the frequent options; --help all shows the others
    config: Path | None = None
    """TOML file of settings, such as the run.toml of a result; options override it."""

    def __post_init__(self) -> None:
        check_settings(self)
        for field in dataclasses.fields(self):
            if isinstance(value := getattr(self, field.name), Path):
                object.__setattr__(self, field.name, local_path(value, Path(), field.name))

    @classmethod
    def read(cls, arguments: list[str], name: str) -> Self:
        """Return the settings of a command by the arguments of the command line."""
        required = [f.name for f in dataclasses.fields(cls) if f.default is f.default_factory is MISSING]
        return read_settings(cls(**dict.fromkeys(required, MISSING)), arguments, name)


S = TypeVar("S", bound=Settings)
R = TypeVar("R")


def command(name: str, settings: type[S], run: Callable[[S], object]) -> Callable[[list[str]], None]:
    """Return the function that parses the arguments of a command and runs it."""

    def main(arguments: list[str]) -> None:
        compute(run, settings.read(arguments, name))

    return main


def compute(run: Callable[[S], R], settings: S) -> R:
    """Run a command with PyTorch on free cores; PyTorch is first imported here, once the settings are valid."""
    from nerif.reconstruction.device import keep_freed_memory, on_free_cores

    keep_freed_memory()
    try:
        return on_free_cores(run)(settings)
    except InputError as error:
        raise error.renamed(_flags(settings)) from None


def _flags(settings: object) -> dict[str, str]:
    """Return the options of fields by the fields' names, without those that several records have."""
    fields = options(settings).values()
    names = Counter(option.place[-1] for option in fields)
    return {o.place[-1]: o.label for o in fields if names[o.place[-1]] == 1}


def read_settings(default: S, arguments: list[str], name: str, file: Path | None = None) -> S:
    """Return the settings of a command.

    Parameters
    ----------
    default : settings with MISSING for required ones
    arguments : of the command line, without the command
    name : of the command
    file : settings file without --config
    """
    if {"-h", "--help"} & {*arguments}:
        print(help_text(default, f"nerif {name}", everything=arguments[-1] == "all"))
        raise SystemExit(0)
    fields = options(default)
    if file := _config(arguments) or file:
        entries = {present_name(key, fields): value for key, value in _settings_file(file).items()}
        default = merge(default, entries, file)
    try:
        settings = merge(default, values_of(arguments, fields), file=False)
        for option in options(settings).values():
            if option.default is MISSING:
                raise InputError(f"expected {option.values}, got none", field=option.label)
    except InputError as error:
        raise InputError(f"{error}; see nerif {name} --help") from None
    return settings


def setting_of(name: str, arguments: list[str], default: str, file: Path | None = None) -> str:
    """Return a single setting on which the defaults of others depend."""
    file = _config(arguments) or file
    value = flag_value(arguments, name) or (_settings_file(file).get(name) if file is not None else None)
    return str(value or default)


def _config(arguments: list[str]) -> Path | None:
    config = flag_value(arguments, "config")
    return Path(config) if config else None


def _settings_file(path: Path) -> dict[str, Any]:
    entries = {k: v for k, v in read_toml(path, "settings file (--config)").items() if k not in IGNORED_TABLES}
    for name in entries:
        if (option := name.replace("-", "_")) in COMMAND_LINE_ONLY:
            option = option.replace("_", "-")
            raise InputError(f"expected no '{name}' in a file; give --{option} on the command line", field=path)
    return entries
