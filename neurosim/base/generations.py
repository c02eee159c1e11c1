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
#: What asks a program to end.
SIGNALS = [
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
]


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
    """Whether the program was asked to end.

    Attributes:
        pending: it was, and has not been answered yet.
    """

    def __init__(self) -> None:
        self.pending = False


@contextmanager
def deferred_interrupt() -> Iterator[Interrupt]:
    """Let a generation end before Ctrl-C is answered; the second Ctrl-C is answered at once.

    Compiled code that runs on several cores does not survive an exception that is raised in the
    middle of it. SIGTERM and SIGHUP are deferred likewise, where Python handles them. What is
    ignored (``nohup``, a shell's background) stays ignored.

    Raises:
        KeyboardInterrupt: at the second one, also where it came out of compiled code wrapped.
    """
    interrupt, before = Interrupt(), {}
    if threading.current_thread() is threading.main_thread():
        handlers = {number: signal.getsignal(number) for number in SIGNALS}
        before = {number: found for number, found in handlers.items() if callable(found)}

    def answer(number: int, frame: FrameType | None) -> None:
        if interrupt.pending:
            before[number](number, frame)
        interrupt.pending = True

    for number in before:
        signal.signal(number, answer)
    try:
        yield interrupt
    except SystemError as error:
        if not isinstance(error.__cause__, KeyboardInterrupt):
            raise
        raise error.__cause__ from None
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def run_generations(
    stage: Stage,
    total: int,
    label: str,
    *,
    save: Callable[[Mapping[str, Any]], None] | None = None,
    every: float = CHECKPOINT_EVERY,
    progress: bool = True,
) -> bool:
    """Run a stage up to ``total`` generations; return whether Ctrl-C (or a kill) ended it early.

    Args:
        stage: what runs; one that was resumed goes on from ``stage.done``.
        total: generations.
        label: of the progress shown.
        save: keeps the stage's state: now and then, and when it is interrupted.
        every: seconds between two calls of ``save``.
        progress: whether to show progress on stderr.

    Raises:
        KeyboardInterrupt: at a second Ctrl-C, in the middle of a generation.
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
