"""The loop that everything long runs in: generations, progress, checkpoints, Ctrl-C."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from types import FrameType
from typing import Any, Protocol

from neurosim.base.progress import Progress

#: Seconds between checkpoints: a kill loses no more than this.
CHECKPOINT_EVERY = 5.0


class Stage(Protocol):
    """Something that goes on generation after generation.

    Attributes:
        done: generations so far.
    """

    done: int

    def generation(self) -> str:
        """Work one generation; return a short figure of how it stands."""
        ...

    def state(self) -> Mapping[str, Any]:
        """Return all that the next generations depend on, as arrays."""
        ...


class Interrupt:
    """Whether Ctrl-C was pressed.

    Attributes:
        pending: it was, and is to be answered.
    """

    def __init__(self) -> None:
        self.pending = False


@contextmanager
def deferred_interrupt() -> Iterator[Interrupt]:
    """Let a generation end before Ctrl-C is answered; the second Ctrl-C is answered at once.

    Compiled code that runs on several cores does not survive an exception that is raised in the
    middle of it. Where Ctrl-C is ignored (``nohup``, a shell's background) it stays ignored.
    """
    interrupt, before = Interrupt(), signal.getsignal(signal.SIGINT)
    if (
        threading.current_thread() is not threading.main_thread()
        or before is signal.SIG_IGN
        or not callable(before)
    ):
        yield interrupt
        return

    def answer(number: int, frame: FrameType | None) -> None:
        if interrupt.pending:
            before(number, frame)
        interrupt.pending = True

    signal.signal(signal.SIGINT, answer)
    try:
        yield interrupt
    finally:
        signal.signal(signal.SIGINT, before)


def run_generations(
    stage: Stage,
    total: int,
    label: str,
    *,
    save: Callable[[Mapping[str, Any]], None] | None = None,
    every: float = CHECKPOINT_EVERY,
    progress: bool = True,
) -> bool:
    """Run a stage up to ``total`` generations; return whether Ctrl-C ended it early.

    Args:
        stage: what runs; one that was resumed goes on from ``stage.done``.
        total: generations.
        label: of the progress shown.
        save: keeps the stage's state: now and then, and when it is interrupted.
        every: seconds between two calls of ``save``.
        progress: whether to show progress on stderr.

    Raises:
        KeyboardInterrupt: if Ctrl-C came before the first generation had ended.
    """
    bar = Progress(label, total, "generations") if progress else nullcontext()
    with bar as shown, deferred_interrupt() as interrupt:
        if shown is not None and stage.done:
            shown.advance(stage.done)
        saved = time.monotonic()
        while stage.done < total:
            note = stage.generation()
            if shown is not None:
                shown.advance(note=note)
            if interrupt.pending:
                break
            if save is not None and time.monotonic() - saved >= every:
                save(stage.state())
                saved = time.monotonic()
    if interrupt.pending and save is not None:
        save(stage.state())
    return interrupt.pending
