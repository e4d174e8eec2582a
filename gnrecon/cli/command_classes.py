"""What gnrecon's commands do beyond typer's: a default command, suggestions, short help, and completion."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from gnrecon.runtime.errors import UsageError, suggestion

EVERYDAY = {
    "reconstruct": "output reference html preview overwrite crop units max_points quality resolution trim faces",
    "batch": "output recursive jobs timeout overwrite crop units max_points quality resolution trim faces",
    "mesh": "output overwrite resolution crop offset shell units remesh simplify faces",
    "learn": "output report overwrite optimiser budget steps seed resolution data share region interfaces",
}
"""Parameters that ``--help`` lists, command by command; ``--help-all`` lists the others too."""


class DefaultCommandGroup(TyperGroup):
    """A group in which a first word that names no command is a scan; completion follows the same rule."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put ``reconstruct`` before arguments that name no command.

        Raises
        ------
        UsageError
            When the word is no file either, and nearly the name of a command.
        """
        own = {name for parameter in self.params for name in parameter.opts} | set(ctx.help_option_names)
        if args and args[0] not in (*self.commands, *own):
            if not ctx.resilient_parsing:
                _require_no_mistyped_command(args[0], list(self.commands))
            args = ["reconstruct", *args]
        return super().parse_args(ctx, args)


def _require_no_mistyped_command(word: str, commands: list[str]) -> None:
    """Refuse a word that cannot be a file's name and is nearly a command's."""
    if "." in word or "/" in word or word.startswith("-") or Path(word).exists():
        return
    if nearest := suggestion(word, commands, kind=""):
        raise UsageError(f"There is no command and no file {word!r}{nearest}.")


class EverydayHelpCommand(TyperCommand):
    """A command whose ``--help`` lists everyday options, and its ``--help-all`` every one."""

    lists_everything = False

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help text without the options that few runs need; completion still offers them."""
        hidden = {parameter: getattr(parameter, "hidden", False) for parameter in self.params}
        everyday = {"help_all", *EVERYDAY[self.name or ""].split()}
        rare = [one for one in self.params if one.param_type_name == "option" and one.name not in everyday]
        try:
            for parameter in [] if self.lists_everything else rare:
                parameter.hidden = True  # type: ignore[attr-defined]
            super().format_help(ctx, formatter)
        finally:
            for parameter, before in hidden.items():
                parameter.hidden = before  # type: ignore[attr-defined]


def _show_everything(context: typer.Context, chosen: bool) -> None:
    if not chosen or context.resilient_parsing:
        return
    command: Any = context.command
    command.lists_everything = True
    typer.echo(context.get_help())
    raise typer.Exit


HelpAllOption = Annotated[
    bool,
    typer.Option("--help-all", is_eager=True, callback=_show_everything, help="Show all options, with their ranges."),
]


def without_such_option(error: Any) -> str:
    """Return the sentence on a usage error of typer's; an unknown option is answered with the likeliest right one."""
    name, known = getattr(error, "option_name", None), getattr(error, "possibilities", None)
    if name is None or not hasattr(error, "possibilities"):
        return str(error.format_message()) + _rejected_value(error)
    nearest = suggestion(name, known or (), kind="")
    return f"No such option: {name}{nearest}."


def _rejected_value(error: Any) -> str:
    """Return words on the value that was rejected, where the sentence of newer versions of typer leaves it out."""
    causes = getattr(error.__cause__, "errors", None)
    return "" if causes is None else f", but is {causes()[0]['input']!r}"
