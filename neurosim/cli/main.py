"""The ``neurosim`` command and its exit: code 0 on success only, errors in one sentence."""

from __future__ import annotations

import importlib.util
import itertools
import os
import re
import sys
import traceback
import warnings
from pathlib import Path
from typing import NoReturn

import click

import neurosim
from neurosim.base.errors import FileError, UserError
from neurosim.base.interrupts import (
    INTERRUPTED,
    answer_signals,
    asked_to_end,
    exit_code,
    ignore_signals,
    interruption_in,
)
from neurosim.base.registry import PLUGIN
from neurosim.cli._types import PATH
from neurosim.cli.back_to_reality import back_to_reality
from neurosim.cli.build_tables import build_tables
from neurosim.cli.calibrate import calibrate
from neurosim.cli.check_robot import check_robot
from neurosim.cli.dataset import dataset
from neurosim.cli.demo import demo
from neurosim.cli.docs import docs
from neurosim.cli.evolve import evolve
from neurosim.cli.export import export
from neurosim.cli.lab import lab
from neurosim.cli.new import new
from neurosim.cli.pipeline import pipeline
from neurosim.cli.place import place
from neurosim.cli.plan_check import plan_check
from neurosim.cli.print_page import print_page
from neurosim.cli.record import record
from neurosim.cli.report import report
from neurosim.cli.run import run
from neurosim.cli.sample import sample
from neurosim.cli.track import track
from neurosim.cli.train import evaluate, train
from neurosim.cli.view import view
from neurosim.cli.watch import watch


class _InOrder(click.Group):
    """Lists the commands in the order of the pipeline, not of the alphabet."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)


@click.group(cls=_InOrder, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(neurosim.__version__, message="%(prog)s %(version)s")
@click.option(
    "--plugin",
    "plugins",
    type=PATH,
    multiple=True,
    metavar="FILE.py",
    help=(
        "Run a Python file first: robots, tasks and others that it registers work in every "
        "command. Can be given several times."
    ),
)
def cli(plugins: tuple[Path, ...]) -> None:
    """A robot builds its own simulator.

    Record what the robot does, learn a simulator from the recording, evolve a controller in the
    simulator, drive the robot with it. Every command reads the output of the command before it.
    Start with "neurosim demo DEMO", which runs the whole pipeline in the virtual lab.
    """
    for path in plugins:
        run_plugin(path)


def run_plugin(path: Path) -> None:
    """Run a Python file, which registers objects, as ``import`` does.

    Raises:
        FileError: if it is missing or raises an error, with the line of the error.
    """
    if not path.is_file():
        raise FileError(path, "no such file; --plugin takes a Python file")
    # Its name must not be another module's: a file may be called random.py.
    spec = importlib.util.spec_from_file_location(f"{PLUGIN}{path.stem}", path)
    if spec is None or spec.loader is None:
        raise FileError(path, "is not a Python file; its name must end in .py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    sys.path.append(str(path.resolve().parent))  # it may import files next to it
    try:
        spec.loader.exec_module(module)
    except UserError as error:
        raise FileError(path, str(error), line=_line_of(error, path)) from None
    except SyntaxError as error:
        raise FileError(path, f"does not run: {error.msg}", line=error.lineno) from None
    except Exception as error:
        what = f"does not run: {type(error).__name__}: {error}"
        raise FileError(path, what, line=_line_of(error, path)) from None


def _line_of(error: Exception, path: Path) -> int | None:
    """Return the last line of a file in an error's traceback."""
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if Path(frame.filename).resolve() == path.resolve()]
    return lines[-1] if lines else None


for command in (
    print_page,
    place,
    watch,
    check_robot,
    record,
    calibrate,
    track,
    dataset,
    train,
    evaluate,
    sample,
    build_tables,
    evolve,
    view,
    plan_check,
    run,
    back_to_reality,
    export,
    report,
    pipeline,
    lab,
    new,
    demo,
    docs,
):
    cli.add_command(command)


def main() -> None:
    """Run the command line; the only place where errors become exit codes."""
    # OpenCV's own messages would appear next to the one sentence and say less.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    # NumPy's warnings of divisions and overflows are for programmers; impossible numbers are errors
    # where they are used.
    ours = r"(neurosim|tracking|numpy)\b"
    warnings.filterwarnings("ignore", category=RuntimeWarning, module=ours)
    try:
        # A closed terminal or a kill must stop the motors as Ctrl-C does.
        answer_signals()
        code = cli.main(standalone_mode=False)  # of a command that ends with exit()
        if asked_to_end() and not code:  # as the last line was written
            _interrupted()
        ignore_signals()
        if code:
            sys.exit(code)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except (KeyboardInterrupt, click.exceptions.Abort, SystemError) as error:
        if isinstance(error, SystemError) and interruption_in(error) is None:
            raise
        _interrupted()
    except MemoryError:
        click.echo("neurosim: there is not enough memory for this; use smaller sizes", err=True)
        sys.exit(1)
    except UserError as error:
        click.echo(f"neurosim: {error}", err=True)
        sys.exit(exit_code() if asked_to_end() else 1)
    except BrokenPipeError:
        # The reader of a pipe has ended (head, less): no message is needed.
        sys.stderr.close()
        sys.exit(1)
    except OSError as error:
        # Disk full, no permission: the user can correct it, and the message names the file.
        where = f": {error.filename}" if error.filename else ""
        click.echo(f"neurosim: {error.strerror or error}{where}", err=True)
        sys.exit(1)
    except Exception as error:
        if asked_to_end():  # a compiler wrapped it in another error
            _interrupted()
        if not str(error).startswith("Symlink loop"):  # the error of Path.resolve
            raise
        click.echo(f"neurosim: a link leads to itself: {str(error).split(' from ')[-1]}", err=True)
        sys.exit(1)


def _interrupted() -> NoReturn:
    ignore_signals()
    click.echo(INTERRUPTED + _again(cli.commands.get(next(iter(sys.argv[1:]), ""))), err=True)
    sys.exit(exit_code())


#: What may follow the name of an output of which something has been saved.
_BEGUN = ("", ".checkpoint")


def _again(command: click.Command | None) -> str:
    """Return how a command continues after an interruption; empty if it does not."""
    given = [value for name, value in itertools.pairwise(sys.argv) if name in ("-o", "--out")]
    given += [match[1] for word in sys.argv if (match := re.fullmatch(r"(?:-o|--out=)(.+)", word))]
    if command is None or (given and not any(Path(given[-1] + end).exists() for end in _BEGUN)):
        return ""
    if any(option.name == "resume" for option in command.params):
        return "; to continue, run the command again with --resume"
    return "; to continue, run the command again" if command in (demo, pipeline) else ""
