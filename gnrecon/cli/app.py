"""The command line: ``gnrecon scan.ply -o mesh.obj``, and the other commands by name.

A first word that names no command is a scan. Results go to files, requested figures to stdout, everything else to
stderr. Each foreseen failure ends in one sentence and the exit code of `gnrecon.runtime.errors`.
"""

from __future__ import annotations

import os
import shlex
import sys
import warnings
from collections.abc import Callable, Sequence
from inspect import signature
from typing import Any, NoReturn

import typer

from gnrecon.cli.batch_command import batch_command
from gnrecon.cli.command_classes import DefaultCommandGroup, EverydayHelpCommand, without_such_option
from gnrecon.cli.inspect_commands import (
    check_command,
    convert_command,
    doctor_command,
    eval_command,
    info_command,
    schema_command,
)
from gnrecon.cli.learn_command import learn_command
from gnrecon.cli.mesh_command import mesh_command
from gnrecon.cli.reconstruct_command import reconstruct_command
from gnrecon.cli.streams import lenient_streams
from gnrecon.cli.supervision import continue_in_child
from gnrecon.runtime.errors import ExitCode, failure
from gnrecon.runtime.files import one_line
from gnrecon.runtime.interrupts import ignore_interrupts, polite_ends, reraised
from gnrecon.runtime.memory_budget import is_capped, require_room_for_libraries
from gnrecon.runtime.process import end_process, settle_process
from gnrecon.version import __version__

COMMANDS: dict[str, Callable[..., None]] = {
    "reconstruct": reconstruct_command,
    "batch": batch_command,
    "mesh": mesh_command,
    "learn": learn_command,
    "eval": eval_command,
    "convert": convert_command,
    "check": check_command,
    "info": info_command,
    "doctor": doctor_command,
    "schema": schema_command,
}

LIGHT_COMMANDS = ("--help", "--help-all", "check", "convert", "doctor", "schema")
"""Words of commands that load no torch and no open3d."""


def command_line_app() -> typer.Typer:
    """Return the typer application with all commands."""
    app = typer.Typer(
        name="gnrecon",
        help="Watertight, verified meshes from point clouds: gnrecon SCAN -o MESH",
        epilog="Exit codes: 0 ok, 1 unforeseen, 2 usage, 3 input, 4 fit, 5 mesh not sound, 6 could not write, "
        "7 memory, 8 some of a batch failed, 130 interrupted (Ctrl-C, SIGTERM or SIGHUP).",
        cls=DefaultCommandGroup,
        no_args_is_help=False,  # `main` does it: newer versions of typer also raise an error without a sentence
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    for name, command in COMMANDS.items():
        app.command(name, cls=EverydayHelpCommand if "help_all" in signature(command).parameters else None)(command)
    return app


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command line and exit."""
    with lenient_streams() as streams, polite_ends(process_ends=arguments is None):
        if is_capped():
            continue_in_child()
        if arguments is None:
            settle_process(os.environ)
        words = list(sys.argv[1:] if arguments is None else arguments)
        try:
            code = _run(words)
        except KeyboardInterrupt:  # before the first step of a command, or after its last
            code = _fail(*failure(KeyboardInterrupt()), words)
        ignore_interrupts()
        code = streams.exit_code(code)
    if arguments is None:
        end_process(code)
    sys.exit(code)


def _run(words: list[str]) -> int:
    """Run the command line's words and return the exit code."""
    if words in (["--version"], ["-V"]):
        print(f"gnrecon {__version__}")
        return ExitCode.OK
    command = shlex.join(["gnrecon", *words])
    # Warnings of libraries are for programmers; -W and PYTHONWARNINGS show them.
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
    try:
        if words or "_GNRECON_COMPLETE" in os.environ:  # a shell that completes a line gives no words
            return _guarded(words, command)
        return _guarded(["--help"], command) or ExitCode.USAGE
    except SystemExit as end:
        # Commands end by it; a code that is no number is a sentence.
        return end.code if isinstance(end.code, int) else ExitCode.OK if end.code is None else ExitCode.UNFORESEEN


def _guarded(words: list[str], command: str, *, least_mb: float = 1000.0, least_light_mb: float = 300.0) -> int:
    """Run the arguments and turn every failure into a sentence and an exit code.

    Parameters
    ----------
    words : arguments
    command : what was typed
    least_mb, least_light_mb : addresses that the libraries of commands take (measured: 750 and 215), and some work
    """
    try:
        light = not words or words[0] in LIGHT_COMMANDS
        require_room_for_libraries(least_light_mb if light else least_mb)
        # After an interrupt, a failure is its consequence: the best field so far may have no surface yet.
        with reraised():
            result: Any = command_line_app()(words, prog_name="gnrecon", standalone_mode=False, obj=command)
        # Newer versions of typer turn Ctrl-C into this value silently; `run` and `run_batch` raise SystemExit.
        if result == ExitCode.INTERRUPTED:
            raise KeyboardInterrupt
        return int(result or 0)
    except typer.Exit as request:
        return request.exit_code
    except _click_exception() as error:
        return _fail(without_such_option(error), ExitCode.USAGE, words)
    except (KeyboardInterrupt, typer.Abort):
        return _fail(*failure(KeyboardInterrupt()), words)
    except Exception as error:
        return _fail(*failure(error), words)


def _click_exception() -> Any:
    """The base of click's usage errors; newer versions of typer carry their own click, older ones import it."""
    return typer.BadParameter.__mro__[2]


def _fail(sentence: str, code: ExitCode, words: list[str]) -> int:
    if "--debug" in words:
        import traceback

        traceback.print_exc()
    print(f"gnrecon: {one_line(sentence)}", file=sys.stderr)
    return int(code)
