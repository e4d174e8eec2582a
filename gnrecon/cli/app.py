"""The command line: ``gnrecon scan.ply -o mesh.obj``, and the other commands by name.

A first word that names no command is a scan. Results go to files, requested figures to stdout, everything else to
stderr. Each foreseen failure ends in one sentence and the exit code of `gnrecon.runtime.errors`.
"""

from __future__ import annotations

import io
import os
import shlex
import signal
import sys
import warnings
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Any, NoReturn

import typer

from gnrecon.cli.batch_command import batch_command
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
from gnrecon.runtime.errors import ExitCode, failure
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


def command_line_app() -> typer.Typer:
    """Return the typer application with all commands."""
    app = typer.Typer(
        name="gnrecon",
        help="Watertight, verified meshes from point clouds: gnrecon SCAN -o MESH",
        epilog="Exit codes: 0 ok, 1 unforeseen, 2 usage, 3 input, 4 fit, 5 mesh not sound, 6 could not write, "
        "7 memory, 8 some of a batch failed, 130 interrupted.",
        add_completion=False,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    for name, command in COMMANDS.items():
        app.command(name)(command)
    return app


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command line and exit."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words == ["--version"]:
        print(f"gnrecon {__version__}")
        sys.exit(0)
    command = shlex.join(["gnrecon", *words])
    if words and words[0] not in (*COMMANDS, "-h", "--help"):
        words.insert(0, "reconstruct")
    # On a busy machine, threads that spin while they wait slow the run down several times.
    # Warnings of libraries are for programmers; -W and PYTHONWARNINGS show them.
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # Names of files may hold bytes that are not UTF-8.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    # SIGTERM must unwind the stack, so that temporary files are removed.
    signal.signal(signal.SIGTERM, _terminate)
    sys.exit(_guarded(words, command))


def _terminate(number: int, frame: FrameType | None) -> NoReturn:
    del frame
    raise SystemExit(128 + number)


def _guarded(words: list[str], command: str) -> int:
    """Run the arguments and turn every failure into a sentence and an exit code; `command` is what was typed."""
    try:
        result: Any = command_line_app()(words, standalone_mode=False, obj=command)
        # Newer versions of typer turn Ctrl-C into this value silently; `run` and `run_batch` raise SystemExit.
        if result == ExitCode.INTERRUPTED:
            raise KeyboardInterrupt
        return int(result or 0)
    except typer.Exit as request:
        return request.exit_code
    except _click_exception() as error:
        return _fail(error.format_message(), ExitCode.USAGE, words)
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
    print(f"gnrecon: {sentence}", file=sys.stderr)
    return int(code)
