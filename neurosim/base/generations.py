"""The loop of all long computations: generations, progress, checkpoints, Ctrl-C."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from typing import Any, Protocol

from neurosim.base.interrupts import deferred_interrupt
from neurosim.base.progress import Progress

#: Seconds between checkpoints, the most that a kill loses.
CHECKPOINT_EVERY = 5.0
#: After this time, s, a message explains why a computation is slow.
COMPILES_AFTER = 4.0


class Stage(Protocol):
    """A computation in generations."""

    @property
    def done(self) -> int:
        """Number of generations so far."""
        ...

    @property
    def ended(self) -> bool:
        """Whether there is nothing to gain from further generations."""
        ...

    def generation(self) -> str:
        """Compute one generation; return a short figure of its progress."""
        ...

    def state(self) -> Mapping[str, Any]:
        """Return as arrays all values on which the next generations depend."""
        ...


def compiling_notice(what: str, say: Callable[[str], None] | None = None) -> threading.Timer:
    """Start a timer whose message explains a slow first generation; cancel it to prevent this.

    Args:
        what: the computation: "the first generation".
        say: takes the message; by default it goes to stderr.
    """
    return slow_notice(
        f"{what} is under way; the first time on a computer its loops are compiled, which takes "
        "up to half a minute and is kept",
        say,
    )


def slow_notice(message: str, say: Callable[[str], None] | None = None) -> threading.Timer:
    """Start a timer whose message explains a slow computation; cancel it to prevent this.

    Args:
        message: the message.
        say: takes it; by default it goes to stderr.
    """
    timer = threading.Timer(COMPILES_AFTER, say or _to_stderr, (message,))
    timer.daemon = True
    timer.start()
    return timer


def _to_stderr(message: str) -> None:
    print(message, file=sys.stderr, flush=True)


def run_generations(
    stage: Stage,
    total: int,
    label: str,
    *,
    save: Callable[[Mapping[str, Any]], None] | None = None,
    every: float = CHECKPOINT_EVERY,
    progress: bool = True,
    after: Callable[[], None] | None = None,
) -> bool:
    """Run a stage up to ``total`` generations; return whether Ctrl-C (or a kill) ended it early.

    Args:
        stage: the computation; a resumed one continues from ``stage.done``.
        total: generations.
        label: of the progress shown.
        save: saves the stage's state: from time to time, and when it is interrupted.
        every: seconds between two calls of ``save``.
        progress: whether to show progress on stderr.
        after: called after each generation.

    Raises:
        KeyboardInterrupt: at a second Ctrl-C, in the middle of a generation.
    """
    bar = Progress(label, total, "generations") if progress else nullcontext()
    with bar as shown, deferred_interrupt() as interrupt:
        if shown is not None and stage.done:
            shown.advance(stage.done)
        saved = time.monotonic()
        say = (lambda message: None) if shown is None else shown.say
        slow = compiling_notice(f"{label}: the first generation", say)
        while stage.done < total and not stage.ended:
            note = stage.generation()
            slow.cancel()
            if after is not None:
                after()
            if shown is not None:
                shown.advance(note=note)
            if interrupt.pending:
                break
            if save is not None and time.monotonic() - saved >= every:
                save(stage.state())
                saved = time.monotonic()
        slow.cancel()
    if interrupt.pending and save is not None:
        save(stage.state())
    return interrupt.pending
