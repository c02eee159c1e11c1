"""What asks a program to end, Ctrl-C, a kill or a closed terminal, and when that is answered."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

#: What asks a program to end: Ctrl-C, a kill, a closed terminal, Ctrl-backslash.
SIGNALS = [
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT")
    if hasattr(signal, name)
]


#: The one that asked last.
_last = [int(signal.SIGINT)]

#: Whether something runs in the main thread that is not to be interrupted.
_outer = [False]


def answer_signals() -> None:
    """Have what asks this program to end raise KeyboardInterrupt.

    What is ignored (``nohup``, a shell's background) stays ignored.
    """
    _last[0] = int(signal.SIGINT)
    for number in SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _interrupt)


def exit_code() -> int:
    """Return the exit code of a program that was interrupted: 128 and the signal's number."""
    return 128 + _last[0]


def _interrupt(number: int, frame: FrameType | None) -> None:
    _last[0] = number
    raise KeyboardInterrupt


def interruption_in(error: BaseException) -> KeyboardInterrupt | None:
    """Return the interruption that an error is, or came from; None if it is another error.

    Ctrl-C within compiled code comes out of it wrapped, once or more often.
    """
    waiting, seen = [error], set()
    while waiting:
        each = waiting.pop()
        if isinstance(each, KeyboardInterrupt):
            return each
        if id(each) not in seen and (each is error or isinstance(each, SystemError)):
            seen.add(id(each))
            waiting += [one for one in (each.__cause__, each.__context__) if one is not None]
    return None


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
    middle of it. SIGTERM, SIGHUP and SIGQUIT are deferred likewise, where Python handles them.
    What is ignored (``nohup``, a shell's background) stays ignored.

    Raises:
        KeyboardInterrupt: at the second one, also where it came out of compiled code wrapped.
    """
    interrupt = Interrupt()

    def answer(number: int, frame: FrameType | None) -> None:
        if interrupt.pending:
            before[number](number, frame)
        _last[0], interrupt.pending = number, True

    before = _replaced(answer)
    try:
        yield interrupt
    except SystemError as error:
        found = interruption_in(error)
        if found is None:
            raise
        raise found from None
    finally:
        _put_back(before)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Let what runs inside end before anything that asks the program to end is answered.

    For compiled code that runs on several cores, which does not survive an exception that is
    raised in the middle of it (:func:`deferred_interrupt` is for a whole generation). What came
    meanwhile is answered at the end, by whoever would have answered it; the third is answered at
    once, for what runs inside may be anything. Within another one it does nothing: the outer one
    answers. Also a decorator.

    Raises:
        KeyboardInterrupt: at the end, or at the third.
    """
    came: list[int] = []

    def answer(number: int, frame: FrameType | None) -> None:
        came.append(number)
        if len(came) > 2:
            before[number](number, frame)

    if _outer[0] or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = _replaced(answer)
    try:
        _outer[0] = True
        yield
    finally:
        _outer[0] = False
        _put_back(before)
        for number in came:
            before[number](number, None)


@contextmanager
def not_suspended() -> Iterator[None]:
    """Have Ctrl-Z end what runs inside, as Ctrl-C does: a suspended program stops no motors."""
    number = getattr(signal, "SIGTSTP", None)
    if number is None or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(number)
    if before == signal.SIG_IGN:
        yield
        return
    signal.signal(number, _interrupt)
    try:
        yield
    finally:
        signal.signal(number, before)


def _replaced(answer: Any) -> dict[int, Any]:
    """Have a function answer what Python handles of the signals; return what answered it before."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    before = {number: found for number, found in handlers.items() if callable(found)}
    for number in before:
        signal.signal(number, answer)
    return before


def _put_back(before: dict[int, Any]) -> None:
    for number, handler in before.items():
        signal.signal(number, handler)
