"""The help of commands: what is common first, all options by group where they are asked for."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

from approxjac.cli.options import POSITIONAL
from approxjac.cli.parser import Option
from approxjac.errors import UnknownNameError
from approxjac.formatting import width, wrapped

_INDENT = 26
_NAMES = {float: "N", int: "N", str: "NAME", Path: "PATH"}
_COMPLETION = """_approxjac() {{
  local words='{commands}'
  [ "$COMP_CWORD" -gt 1 ] && case ${{COMP_WORDS[1]}} in
{cases}
  esac
  COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o default -F _approxjac approxjac"""


def of_commands(commands: Mapping[str, Callable[..., int]]) -> str:
    """Return the list of commands, a line each."""
    lines = ["usage: approxjac COMMAND [options]", ""]
    lines += wrapped("Torque control of any URDF arm whose kinematics are not exactly known.")
    lines.append("")
    for name, command in commands.items():
        lines += _entry(name, _paragraphs(command)[0], 14)
    text = (
        "COMMAND --help says more of each command, with examples; --version prints the version. "
        "Exit codes are 0, 1 where a verdict fell short, and 2 for bad input."
    )
    return "\n".join([*lines, "", *wrapped(text)])


def completion(shell: str, options: Mapping[str, Sequence[Option]]) -> str:
    """Return a script with which a shell completes commands, and the options of each."""
    if shell not in ("bash", "zsh"):
        raise UnknownNameError("shell", shell, "--completion", ("bash", "zsh"))
    names = {k: " ".join(name for each in v for name in each.names) for k, v in options.items()}
    cases = "\n".join(f"    {name}) words='{text}' ;;" for name, text in names.items())
    script = _COMPLETION.format(commands=" ".join(options), cases=cases)
    zsh = "autoload -U +X compinit bashcompinit && compinit && bashcompinit\n"
    return zsh + script if shell == "zsh" else script


def of_command(
    command: Callable[..., int],
    options: Sequence[Option],
    common: Sequence[str] = (),
) -> str:
    """Return the help of a command.

    Args:
        command: The command.
        options: Those to show.
        common: Options to show alone, with a hint at the others; all by default.
    """
    word, meaning = POSITIONAL.get(command.__name__, ("", ""))
    lines = [" ".join(["usage: approxjac", command.__name__, word, "[options]"]).replace("  ", " ")]
    for paragraph in _paragraphs(command):
        lines += ["", *_wrapped(paragraph)]
    if word:
        lines += ["", *_entry(word, f"{meaning[0].upper()}{meaning[1:]}.", _INDENT)]
    groups: dict[str, list[Option]] = {}
    for option in options:
        if not common or set(option.names) & set(common):
            group = "" if common else option.key.rpartition(".")[0]
            groups.setdefault(group, []).append(option)
    for group, members in groups.items():
        title = "Common options" if common else f"[{group}]" if group else "Options"
        lines += ["", title]
        for option in members:
            # all names only where all options are shown
            name = option.names[0] if common else ", ".join(option.names)
            lines += _entry(f"{name} {_values(option.hint)}".rstrip(), _text(option), _INDENT)
    if common:
        text = (
            f"All {len(options)} options: approxjac {command.__name__} --help-all. Each is a key "
            "of a scenario file: --sensor.noise 0.001 is noise = 0.001 below [sensor]."
        )
        lines += ["", *wrapped(text)]
    return "\n".join(lines)


def _paragraphs(command: Callable[..., int]) -> list[str]:
    """Return the paragraphs of a command's docstring before its arguments."""
    text = inspect.cleandoc(command.__doc__ or "").partition("\nArgs:")[0]
    return [part.strip() for part in text.split("\n\n")]


def _wrapped(paragraph: str) -> list[str]:
    """Return a paragraph, wrapped; an example stays what can be copied."""
    if paragraph.startswith("Example: "):
        return [paragraph]
    return wrapped(paragraph)


def _text(option: Option) -> str:
    """Return what an option is for, and its default where the text has none."""
    default = option.default
    if default in (None, "", (), False) or default == {} or "default" in option.help:
        return option.help
    if isinstance(default, tuple):
        default = " ".join(
            f"{each:g}" if isinstance(each, float) else f"{each}" for each in default
        )
    elif isinstance(default, float):
        default = f"{default:g}"
    return f"{option.help} (default: {default})"


def _entry(name: str, text: str, indent: int) -> list[str]:
    """Return a name with a text beside it, or below where the name is long."""
    indent = min(indent, width() // 2)
    lines = wrapped(text, " " * indent)
    if len(name) + 4 > indent:
        return [f"  {name}", *lines]
    return [f"  {name}".ljust(indent) + lines[0][indent:], *lines[1:]]


def _values(hint: Any) -> str:
    """Return the value of an option as its help shows it."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return "|".join(_values(kind) for kind in inner if kind is not type(None))
    if origin is Literal:
        return "|".join(inner)
    if origin is dict:
        return "JOINT X Y Z ..."
    if origin is tuple:
        each = _NAMES[inner[0]]
        return f"{each} ..." if inner[-1] is Ellipsis else " ".join([each] * len(inner))
    return "" if hint is bool else _NAMES[hint]
