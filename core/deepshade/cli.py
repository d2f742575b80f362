"""The `deepshade` command. Its subcommands are entry points, loaded when they are needed."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib.metadata import EntryPoint, entry_points, version
from typing import Annotated, Any

import typer
import typer.core

from deepshade.errors import DeepshadeError, nearest
from deepshade.extras import extra_of, install_command

GROUP = "deepshade.commands"
CONTEXT = {"help_option_names": ["-h", "--help"]}

# shown in the commands' help; `run` answers it, after any subcommand too
Version = Annotated[bool, typer.Option("--version", help="Print the version and exit.")]


class Commands(typer.core.TyperGroup):
    """The subcommands that the installed packages offer under the entry point group."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names of all subcommands, in alphabetical order."""
        return sorted({point.name for point in entry_points(group=GROUP)})

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Loads one subcommand; one whose module can't be imported says so when it is run."""
        for point in entry_points(group=GROUP):
            if point.name == cmd_name:
                return _command(point)
        return None

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """As usual, but a mistyped name gets the nearest one as a hint."""
        if args and self.get_command(ctx, args[0]) is None and not args[0].startswith("-"):
            near = nearest(args[0], self.list_commands(ctx))
            hint = f" Did you mean '{near}'?" if near else ""
            ctx.fail(f"No such command '{args[0]}'.{hint}")
        return super().resolve_command(ctx, args)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs `deepshade`; returns the exit code."""
    return run(application(), argv, name="deepshade")


def application() -> Any:
    """The command with all its subcommands."""
    app = typer.Typer(cls=Commands, no_args_is_help=True, context_settings=CONTEXT)
    app.callback()(_root)
    return typer.main.get_command(app)


def run(command: Any, argv: Sequence[str] | None = None, *, name: str) -> int:
    """Runs a click command and turns what it raises into a message and an exit code.

    2 for wrong usage or input, unless a DeepshadeError says otherwise; 1 for an aborted prompt,
    130 for Ctrl-C, 141 when the reader of our output went away.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if "--version" in arguments:
        print(f"deepshade {version('deepshade')}")
        return 0
    try:
        result = command.main(args=arguments, prog_name=name, standalone_mode=False)
        sys.stdout.flush()
        return result if isinstance(result, int) else 0
    except DeepshadeError as error:
        _complain(str(error), error.fix)
        return error.exit_code
    except ModuleNotFoundError as error:
        extra = extra_of(error.name or "")
        if extra is None:
            raise
        _complain(
            f"this needs the '{extra}' extra (no module '{error.name}')",
            install_command(extra),
        )
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # the interpreter flushes once more when it ends: let that go nowhere
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _complain(f"{where}{error.strerror or error}", "")
        return 2
    except Exception as error:
        if type(error).__name__ == "Abort":
            print("aborted", file=sys.stderr)
            return 1
        show, code = getattr(error, "show", None), getattr(error, "exit_code", None)
        if show is None or code is None:
            raise  # not of click's: a bug, which keeps its traceback
        show()
        return int(code)


def _root(show_version: Version = False) -> None:
    """Neural screen-space shading: a G-buffer in, shaded appearance out.

    Examples:

      deepshade doctor

      deepshade serve

      deepshade COMMAND --help
    """


def _command(point: EntryPoint) -> Any:
    app = typer.Typer(add_completion=False, context_settings=CONTEXT)
    try:
        function = point.load()
    except (ImportError, AttributeError) as error:
        function = _unavailable(error)
        app.command(point.name, context_settings={"ignore_unknown_options": True})(function)
    else:
        app.command(point.name)(function)
    return typer.main.get_command(app)


def _unavailable(error: Exception) -> Any:
    def command(arguments: list[str] = typer.Argument(None, hidden=True)) -> None:
        raise error

    command.__doc__ = f"(not available: {error})"
    return command


def _complain(message: str, fix: str) -> None:
    print(f"error: {message}", file=sys.stderr)
    if fix:
        print(f"  fix: {fix}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
