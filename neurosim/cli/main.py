"""The ``neurosim`` command and how it ends: 0 on success only, errors in one sentence."""

from __future__ import annotations

import os
import signal
import sys

import click

import neurosim
from neurosim.base.errors import UserError
from neurosim.cli.calibrate import calibrate
from neurosim.cli.dataset import dataset
from neurosim.cli.demo import demo
from neurosim.cli.evolve import evolve
from neurosim.cli.lab import lab
from neurosim.cli.plan_check import plan_check
from neurosim.cli.record import record
from neurosim.cli.report import report
from neurosim.cli.run import run
from neurosim.cli.sample import sample
from neurosim.cli.tables import tables
from neurosim.cli.track import track
from neurosim.cli.train import evaluate, train
from neurosim.cli.view import view
from neurosim.cli.watch import watch


class _InOrder(click.Group):
    """Lists the verbs in the order of the road, not of the alphabet."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)


@click.group(cls=_InOrder, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(neurosim.__version__, message="%(prog)s %(version)s")
def cli() -> None:
    """A robot builds its own simulator.

    Record what the robot does, learn a simulator from the recording, evolve a controller in the
    simulator, drive the robot with it. Every verb reads what the verb before it wrote; start
    with "neurosim demo DEMO", which walks the whole road in the virtual lab.
    """


for verb in (
    watch,
    record,
    calibrate,
    track,
    dataset,
    train,
    evaluate,
    sample,
    tables,
    evolve,
    view,
    plan_check,
    run,
    report,
    lab,
    demo,
):
    cli.add_command(verb)


def _interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt


def main() -> None:
    """Run the command line; the only place where errors become exit codes."""
    # OpenCV's own complaints stand beside the one sentence and say less.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    # A closed terminal or a kill must stop the motors as Ctrl-C does.
    for name in ("SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), _interrupt)
    try:
        cli.main(standalone_mode=False)
    except click.exceptions.Exit as stop:
        sys.exit(stop.exit_code)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except (KeyboardInterrupt, click.exceptions.Abort):
        _interrupted()
    except SystemError as error:
        # Ctrl-C within a compiled kernel comes out of it wrapped.
        if not isinstance(error.__cause__, KeyboardInterrupt):
            raise
        _interrupted()
    except MemoryError:
        click.echo("neurosim: there is not enough memory for this; use smaller sizes", err=True)
        sys.exit(1)
    except UserError as error:
        click.echo(f"neurosim: {error}", err=True)
        sys.exit(1)
    except BrokenPipeError:
        # The reader of a pipe went away (head, less): not worth a word.
        sys.stderr.close()
        sys.exit(1)
    except OSError as error:
        # Disk full, no permission: the user's to put right, and the file is named.
        where = f": {error.filename}" if error.filename else ""
        click.echo(f"neurosim: {error.strerror or error}{where}", err=True)
        sys.exit(1)


def _interrupted() -> None:
    click.echo(
        "neurosim: interrupted; what was written so far can be read, "
        "and is gone on with by --resume where there is one",
        err=True,
    )
    sys.exit(130)
