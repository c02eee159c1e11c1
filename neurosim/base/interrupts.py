"""Signals that end a program (Ctrl-C, a kill, a closed terminal), and when they are handled."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

#: Signals that ask a program to end: Ctrl-C, a kill, a closed terminal, Ctrl-backslash.
SIGNALS = [
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT")
    if hasattr(signal, name)
]


#: Time after which a process that was asked to end is ended, s; and the time where a generation or
#: a compiled loop runs, which must not be interrupted, unless it is only being compiled.
PATIENCE, LONGEST = 4.0, 60.0

#: The last signal.
_last = [int(signal.SIGINT)]
#: Number of signals since :func:`forget_signals`; whether :func:`_watch` waits for the end.
_asked, _watched = [0], [False]
#: Whether the main thread runs code that must not be interrupted.
_outer = [False]
#: Number of running blocks that delay signals until their end, and the time of the last end.
_deferring, _deferred_until = [0], [0.0]
#: Whether this process is the command line's own, and may be ended by :func:`end_now`.
_own_process = [False]
#: Functions that stop motors, for a process that must be ended.
_stops: list[Callable[[], object]] = []


def own_process() -> None:
    """Mark this process as the command line's own, which is ended if it does not end in time.

    Signals before :func:`answer_signals` end it at once, because nothing has begun.
    """
    _own_process[0] = True
    for number in SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, lambda number, frame: end_now(number))
    # Python runs handlers between two of its own steps, and a compiler may take a minute for one.
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    if hasattr(os, "register_at_fork"):  # a signal to a child is not for this process
        os.register_at_fork(after_in_child=lambda: signal.set_wakeup_fd(-1))
    threading.Thread(target=_watch, args=(reader,), name="end", daemon=True).start()
    ignored = sys.unraisablehook

    def again(unraisable: Any) -> None:
        # An exception within a callback of compiled code (Numba's compiler) had no effect.
        if unraisable.exc_type is KeyboardInterrupt:
            threading.Timer(0.05, os.kill, (os.getpid(), _last[0])).start()
        else:
            ignored(unraisable)

    sys.unraisablehook = again


def asked_to_end() -> bool:
    """Return whether a signal asked this program to end, handled or not."""
    return _asked[0] > 0


def forget_signals() -> None:
    """Treat the signals so far as handled, for a program that Ctrl-C ends normally."""
    _asked[0], _watched[0] = 0, False


def ended_as_usual() -> None:
    """Handle Ctrl-C as the normal end of a program; other signals still interrupt it."""
    if _last[0] == signal.SIGINT:
        forget_signals()


def ignore_signals() -> None:
    """Ignore further signals, because the process of the command line is ending."""
    if _own_process[0]:
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN)


@contextmanager
def stopped_at_end(stop: Callable[[], object]) -> Iterator[None]:
    """Stop motors by ``stop`` if the process must be ended while the block runs."""
    _stops.append(stop)
    try:
        yield
    finally:
        _stops.remove(stop)


def end_now(number: int) -> None:
    """End this process at once by its signal; stop the motors if possible."""
    for stop in list(_stops):
        thread = threading.Thread(target=_quietly, args=(stop,), daemon=True)
        thread.start()
        thread.join(1.0)
    with suppress(OSError):
        os.write(2, INTERRUPTED.encode() + b"\n")
    os._exit(128 + number)


#: Message of an interrupted program.
INTERRUPTED = "neurosim: interrupted; complete files can be read"


def _quietly(stop: Callable[[], object]) -> None:
    with suppress(BaseException):
        stop()


def _note(number: int) -> None:
    """Record a signal that asked to end."""
    _last[0] = number
    _asked[0] += 1


def _watch(reader: int) -> None:
    """End the process if it does not end in time after a signal, whose number comes from a pipe."""
    while True:
        number = os.read(reader, 1)[0]
        began, _watched[0] = time.monotonic(), number in SIGNALS
        while _watched[0]:
            now = time.monotonic()
            if _outer[0] or _deferring[0]:
                late = now > began + (PATIENCE if _compiles() else LONGEST)
            else:
                late = now > max(began, _deferred_until[0]) + PATIENCE
            if late:
                end_now(number)
            time.sleep(0.1)


def _compiles() -> bool:
    """Return whether Numba is compiling, which takes long and may be ended without loss."""
    module = sys.modules.get("numba.core.compiler_lock")
    if module is None:
        return False
    lock = module.global_compiler_lock._lock  # its own is_locked() asks about this thread alone
    free = lock.acquire(blocking=False)
    if free:
        lock.release()
    return not free


def answer_signals() -> None:
    """Make the signals that ask this program to end raise KeyboardInterrupt.

    Signals that are ignored (``nohup``, a shell's background) stay ignored.
    """
    _last[0] = int(signal.SIGINT)
    forget_signals()
    for number in SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _interrupt)


def exit_code() -> int:
    """Return the exit code of a program that was interrupted: 128 and the signal's number."""
    return 128 + _last[0]


def _interrupt(number: int, frame: FrameType | None) -> None:
    _note(number)
    raise KeyboardInterrupt


def interruption_in(error: BaseException) -> KeyboardInterrupt | None:
    """Return the interruption that caused an error, or the error itself if it is one; else None.

    Compiled code wraps a Ctrl-C in other exceptions, once or several times.
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
    """A request to end the program.

    Attributes:
        pending: whether there is one that was not handled yet.
    """

    def __init__(self) -> None:
        self.pending = False


@contextmanager
def deferred_interrupt() -> Iterator[Interrupt]:
    """Let a generation end before Ctrl-C is handled; a second Ctrl-C is handled at once.

    Compiled code that runs on several cores does not survive an exception that is raised in the
    middle of it. SIGTERM, SIGHUP and SIGQUIT are deferred likewise, where Python handles them.
    Signals that are ignored (``nohup``, a shell's background) stay ignored.

    Raises:
        KeyboardInterrupt: at the second one, also if compiled code wrapped it.
    """
    interrupt = Interrupt()

    def answer(number: int, frame: FrameType | None) -> None:
        if interrupt.pending:
            before[number](number, frame)
        _note(number)
        interrupt.pending = True

    before = _replaced(answer)
    _deferring[0] += 1
    try:
        yield interrupt
    except SystemError as error:
        interruption = interruption_in(error)
        if interruption is None:
            raise
        raise interruption from None
    finally:
        _deferring[0] -= 1
        _deferred_until[0] = time.monotonic()
        _put_back(before)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Let the block end before a signal that asks the program to end is handled.

    For compiled code that runs on several cores, which does not survive an exception that is
    raised in the middle of it (:func:`deferred_interrupt` is for a whole generation). Signals that
    came meanwhile are handled at the end, by their former handler. The third is handled at once,
    because the block may take any time. Inside another such block it does nothing: the outer one
    handles them. Also a decorator.

    Raises:
        KeyboardInterrupt: at the end, or at the third.
    """
    came: list[int] = []

    def answer(number: int, frame: FrameType | None) -> None:
        came.append(number)
        if len(came) > 2:
            if _own_process[0]:
                end_now(number)  # an exception here may crash threads of compiled code
            before[number](number, frame)

    if _outer[0] or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = _replaced(answer)
    try:
        _outer[0] = True
        yield
    finally:
        _outer[0], _deferred_until[0] = False, time.monotonic()
        _put_back(before)
        for number in came:
            before[number](number, None)


@contextmanager
def not_suspended() -> Iterator[None]:
    """Make Ctrl-Z end the block like Ctrl-C, because a suspended program cannot stop motors."""
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
    """Set the handler of the signals that Python handles; return the former handlers."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    before = {number: handler for number, handler in handlers.items() if callable(handler)}
    for number in before:
        signal.signal(number, answer)
    return before


def _put_back(before: dict[int, Any]) -> None:
    for number, handler in before.items():
        signal.signal(number, handler)
