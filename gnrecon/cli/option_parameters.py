"""Makes parameters of typer from the rows of `gnrecon.option_table`.

Typer builds a command from the signature of its function. `with_table_options` replaces the ``**options`` of a function
by one parameter for each row, so that no command lists them.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Annotated, Any, get_origin, get_type_hints

import typer

from gnrecon.option_table import OptionRow, Panel, option_rows


def table_option(name: str) -> Any:
    """Return the typer option of a row: its flag, help text, panel and metavar."""
    row = option_rows()[name]
    return typer.Option(
        row.flag,
        help=row.described.replace("[", r"\["),  # typer reads rich's markup
        show_default=False,  # it is in the help text, with what holds where there is none
        rich_help_panel=row.panel.value,
        metavar=row.metavar,
        autocompletion=_completion(row) if row.choices else None,
    )


def valued_option(
    *flags: str, help: str, panel: Panel, default: str, limits: str = "", metavar: str | None = None
) -> Any:
    """Return the typer option of a parameter that is no row of the table.

    Parameters
    ----------
    flags : spellings, where they differ from the parameter's name
    help, panel, metavar : as of a row
    default, limits : default and range of the value in words, which follow the help text
    """
    ends = "; ".join(part for part in (limits, f"default: {default}") if part)
    shown = rf"{help} \[{ends}]"  # typer reads rich's markup
    return typer.Option(*flags, help=shown, show_default=False, rich_help_panel=panel.value, metavar=metavar)


def _completion(row: OptionRow) -> Callable[[str], list[str]]:
    def complete(incomplete: str) -> list[str]:
        return [choice for choice in row.choices if choice.startswith(incomplete)]

    return complete


def with_table_options(*, batch: bool) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that gives a command the options of the table in place of its ``**options``.

    Parameters
    ----------
    batch : whether the command is ``batch``, which has no options that serve a single scan
    """
    panels = list(Panel)
    rows = [row for row in option_rows().values() if row.in_batch or not batch]
    rows.sort(key=lambda row: panels.index(row.panel))  # stable: within a panel, the order of the table stays

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        hints = get_type_hints(command, include_extras=True)
        own = [parameter for name, parameter in inspect.signature(command).parameters.items() if name != "options"]
        own = [parameter.replace(annotation=hints[parameter.name]) for parameter in own]
        parameters = [*own, *map(_parameter, rows)]
        # Typer reads both, depending on its version.
        command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        return command

    return decorate


def _parameter(row: OptionRow) -> inspect.Parameter:
    annotated: Any = Annotated  # type checkers would take Annotated[...] for an alias
    annotation = annotated[_command_line_type(row), table_option(row.name)]
    return inspect.Parameter(row.name, inspect.Parameter.KEYWORD_ONLY, default=row.default, annotation=annotation)


def _command_line_type(row: OptionRow) -> Any:
    """The type that typer reads: texts may be repeated; numbers in a list, or a number or a text, are one text."""
    kind: Any = list[str] if row.types == (tuple[str, ...],) else str if _is_parsed(row) else row.types[-1]
    return kind | None if row.default is None else kind


def _is_parsed(row: OptionRow) -> bool:
    """Whether the command line takes text for a value that is a list of numbers."""
    return get_origin(row.types[0]) is tuple and row.types != (tuple[str, ...],)


def given_options(context: typer.Context, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that were given on the command line, without those left at their defaults.

    Raises
    ------
    UsageError
        When text is not a list of numbers where one is expected.
    """
    from gnrecon.config import typed

    sources = {name: context.get_parameter_source(name) for name in options}
    return {
        name: typed(name, value) if _is_parsed(option_rows()[name]) else value
        for name, value in options.items()
        if (source := sources[name]) is not None and source.name != "DEFAULT"
    }
