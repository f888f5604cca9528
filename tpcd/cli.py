"""The door of every command: configuration in, one line and an exit code out.

A command is a frozen dataclass of settings and a function that takes it. `run` makes the
command line from the dataclass: fields become options, a line of documentation under a
field becomes its help, `--config FILE.yaml` reads saved settings (what the command line
says overrides them), `--print_config` writes them. A command for doubling numbers reads

    @dataclass(frozen=True)
    class Doubling:
        number: float
        \"\"\"The number to double.\"\"\"
        shout: bool = False
        \"\"\"Print it with an exclamation mark.\"\"\"

    def double(config: Doubling) -> None:
        \"\"\"Print twice a number.\"\"\"
        print(2 * config.number, end="!\\n" if config.shout else "\\n")

    if __name__ == "__main__":
        run(double, Doubling, positional=("number",))

Commands import what is heavy (torch) inside their function, so that `--help` is quick.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import sys
import traceback
import typing
from argparse import SUPPRESS
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from tpcd import __version__
from tpcd.cli_messages import check_config_files, parsing_problem, system_problem
from tpcd.console import forgiving_console
from tpcd.errors import TpcdError
from tpcd.plain_yaml import PlainLoader

if typing.TYPE_CHECKING:
    from jsonargparse import ArgumentParser

Config = TypeVar("Config")

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130
OWN = ("tpcd", "training", "eval")
"""Packages of this project; what they lack of each other is a mistake in the program."""
LARGEST_SEED = 2**63 - 1
"""Seeds beyond this do not fit into every generator of random numbers."""


def run(
    main: Callable[[Config], int | None],
    config: type[Config],
    argv: Sequence[str] | None = None,
    *,
    positional: Sequence[str] = (),
    prog: str | None = None,
    description: str | None = None,
) -> NoReturn:
    """Parse the command line into `config`, call `main` with it, and exit.

    `positional` names the fields given without an option name, in order; a list or tuple
    among them takes one or more values. `argv` defaults to the process's arguments, `prog`
    to how the command was called, `description` to the docstring of `main`. A `TpcdError`,
    `ValueError`, `OSError`, or a package that does not load, becomes one line on stderr and a
    non-zero exit code, with the traceback before it under `--debug`; Ctrl-C gives 130. Anything
    else is a mistake in the program and keeps its traceback. What the console cannot show or take
    changes neither the work nor, but for a full disk behind it, the exit code (`console`).
    """
    prog = prog or _program_name()
    arguments = list(sys.argv[1:] if argv is None else argv)
    with forgiving_console() as console:
        code = _code_of(main, config, arguments, positional, prog, description)
        console.flush()
        if console.lost is not None:
            line = system_problem(console.lost)
            print(f"{prog}: standard output: {line}; not all could be printed", file=sys.stderr)
            code = code or EXIT_BAD_INPUT
    sys.exit(code)


def _code_of(
    main: Callable[[Config], int | None],
    config: type[Config],
    arguments: list[str],
    positional: Sequence[str],
    prog: str,
    description: str | None,
) -> int:
    """The exit code of a command; what went wrong is told."""
    debug = "--debug" in arguments
    try:
        settings = parse(
            config,
            arguments,
            positional=positional,
            prog=prog,
            description=description or inspect.getdoc(main),
        )
        return main(settings) or 0
    except KeyboardInterrupt as stop:
        print(f"{prog}: interrupted" + (f"; {stop}" if str(stop) else ""), file=sys.stderr)
        return EXIT_INTERRUPTED
    except (TpcdError, ValueError, OSError, ImportError) as error:
        if isinstance(error, ImportError) and (error.name or "").partition(".")[0] in OWN:
            raise
        if debug:
            traceback.print_exc()
        if isinstance(error, OSError):
            line = system_problem(error)
        elif isinstance(error, ImportError):
            line = f"a package does not load ({error}); install tpcd and what it needs anew"
        else:
            line = " ".join(str(error).split()) or type(error).__name__
        print(f"{prog}: error: {line}", file=sys.stderr)
        return error.exit_code if isinstance(error, TpcdError) else EXIT_BAD_INPUT


def parse(
    config: type[Config],
    argv: Sequence[str],
    *,
    positional: Sequence[str] = (),
    prog: str = "tpcd",
    description: str | None = None,
) -> Config:
    """Read command-line arguments into a configuration; see `run`.

    Raises `ValueError` with one line for an argument that is unknown, missing or of the
    wrong type; `--help`, `--version` and `--print_config` print and exit.
    """
    from jsonargparse import ArgumentError, Namespace

    parser = _parser(config, positional, prog, description)
    words, files = _config_first([_underscored(word) for word in argv])
    check_config_files(files)
    names = [field.name for field in dataclasses.fields(typing.cast(Any, config))]
    try:
        values = parser.parse_args(words)
        for name, kind in typing.get_type_hints(config).items():
            if dataclasses.is_dataclass(kind) and not isinstance(values[name], Namespace):
                raise ValueError(f"{name} is {values[name]!r}, expected settings by name")
        values = parser.instantiate(values)
    except ArgumentError as error:
        problem = parsing_problem(str(error), [*names, "config", "debug"])
        raise ValueError(f"{problem}; see {prog} --help") from error
    settings, types = {}, typing.get_type_hints(config)
    for field in dataclasses.fields(typing.cast(Any, config)):
        if field.name in values:
            origin = typing.get_origin(types[field.name])
            value = values[field.name]
            settings[field.name] = tuple(value) if origin is tuple else value
    missing = [name for name in positional if not _has_default(config, name)]
    missing = [name.upper() for name in missing if settings.get(name) in (None, (), [])]
    if missing:
        raise ValueError(f"{' and '.join(missing)} missing; see {prog} --help")
    return config(**settings)


def check_resume(config: Any) -> None:
    """Refuse, for `__post_init__`, to go on with a run and replace it at once."""
    if config.resume and config.overwrite:
        raise ValueError("give --resume or --overwrite, not both")


def check_numbers(
    config: object,
    least: Mapping[str, int | float] | None = None,
    above: Mapping[str, int | float] | None = None,
    most: Mapping[str, float] | None = None,
) -> None:
    """Refuse fields of a configuration that are too small or large, not finite, or no usable seed.

    For `__post_init__`: `least` and `above` map names of fields to limits, inclusive and
    exclusive, `most` to what a quantity in SI units can be at most; every other number must be
    finite. A tuple is checked value by value, None passes. Raises `ValueError` that names the
    field, what was found and what is expected.
    """
    for name, field in vars(config).items():
        for value in field if isinstance(field, tuple) else (field,):
            if not isinstance(value, (int, float)):
                continue
            if not math.isfinite(value):
                raise ValueError(f"{name} is {value}, expected a finite number")
            if least and name in least and value < least[name]:
                raise ValueError(f"{name} is {value:g}, expected at least {least[name]:g}")
            if above and name in above and value <= above[name]:
                raise ValueError(f"{name} is {value:g}, expected more than {above[name]:g}")
            if most and name in most and abs(value) > most[name]:
                limit = f"expected at most {most[name]:g} in size; lengths are in m, angles in rad"
                raise ValueError(f"{name} is {value:g}, {limit}")
            if name in ("seed", "seeds") and not 0 <= value <= LARGEST_SEED:
                raise ValueError(f"{name} is {value}, expected 0 to {LARGEST_SEED}")


def _parser(
    config: type, positional: Sequence[str], prog: str, description: str | None
) -> ArgumentParser:
    from jsonargparse import ActionYesNo, ArgumentParser, _loaders_dumpers, set_parsing_settings

    set_parsing_settings(docstring_parse_attribute_docstrings=True)
    # Files and single values are read by one loader, for which there is no public door.
    _loaders_dumpers.yaml_default_loader = PlainLoader
    parser = ArgumentParser(
        prog=prog,
        description=description,
        exit_on_error=False,
        version=__version__,
        allow_abbrev=False,
    )
    parser.add_argument("--config", action="config", help="YAML file with settings to start from.")
    parser.add_argument(
        "--debug", action="store_true", default=SUPPRESS, help="Show the traceback of an error."
    )
    types = typing.get_type_hints(config)
    documentation = _field_documentation(config)
    fields = {field.name: field for field in dataclasses.fields(config) if field.init}
    for name in positional:
        # Never required and without a default, since a --config file may hold it.
        parser.add_argument(
            name, **_value_details(types[name], "?"), default=SUPPRESS, help=documentation.get(name)
        )
    for name in [name for name in fields if name not in positional]:
        details: dict[str, Any] = {"help": documentation.get(name)}
        if fields[name].default is not dataclasses.MISSING:
            default = fields[name].default
            details["default"] = list(default) if isinstance(default, tuple) else default
        elif fields[name].default_factory is not dataclasses.MISSING:
            details["default"] = typing.cast(Any, fields[name].default_factory)()
        else:
            details["required"] = True
        if types[name] is bool:
            details["action"] = ActionYesNo(no_prefix="no_")
        else:
            details.update(_value_details(types[name]))
        parser.add_argument(f"--{name}", **details)
    return parser


def _value_details(annotation: Any, single: str | None = None) -> dict[str, Any]:
    """Type and number of values: `--seeds 1 2 3` for `tuple[int, ...]` or `list[int]`."""
    members = typing.get_args(annotation)
    if typing.get_origin(annotation) is list or members[1:] == (...,):
        return {"type": members[0], "nargs": "*"}
    if typing.get_origin(annotation) is tuple and len(set(members)) == 1:
        return {"type": members[0], "nargs": len(members)}
    return {"type": annotation, "nargs": single} if single else {"type": annotation}


def _has_default(config: type, name: str) -> bool:
    field = next(field for field in dataclasses.fields(config) if field.name == name)
    return not (field.default is field.default_factory is dataclasses.MISSING)


def _field_documentation(config: type) -> dict[str, str]:
    """The line under each field; empty where the source is not at hand."""
    import docstring_parser

    parents = [kind for kind in reversed(config.__mro__) if dataclasses.is_dataclass(kind)]
    found = [entry for kind in parents for entry in docstring_parser.parse_from_object(kind).params]
    return {entry.arg_name: entry.description or "" for entry in found}


def _underscored(argument: str) -> str:
    """Let `--floor-height` mean `--floor_height`; values stay as they are."""
    if not argument.startswith("--"):
        return argument
    name, equals, value = argument.partition("=")
    return "--" + name[2:].replace("-", "_") + equals + value


def _config_first(arguments: list[str]) -> tuple[list[str], list[str]]:
    """Move `--config FILE` to the front, so that it never overrides the command line.

    Returns all words, and the files among them.
    """
    files, rest, words = [], [], iter(arguments)
    for word in words:
        if word == "--config":
            file = next(words, None)
            if file is None:
                raise ValueError("--config: the file is missing")
            files.append(file)
        elif word.startswith("--config="):
            files.append(word.removeprefix("--config="))
        else:
            rest.append(word)
    return [*(f"--config={file}" for file in files), *rest], files


def _program_name() -> str:
    """How the user called this program: a script's file name, or `python -m module`."""
    spec = getattr(sys.modules.get("__main__"), "__spec__", None)
    if spec is not None and spec.name:
        return f"python -m {spec.name.removesuffix('.__main__')}"
    return Path(sys.argv[0]).name
