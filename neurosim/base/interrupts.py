"""Signals that end a program (Ctrl-C, a kill, a closed terminal), and when they are answered."""

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

#: What asks a program to end: Ctrl-C, a kill, a closed terminal, Ctrl-backslash.
SIGNALS = [
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT")
    if hasattr(signal, name)
]


#: A process that was asked to end is ended after so long, s; where something runs that must not be
#: interrupted (a generation, a compiled loop), after so long, unless it is only being compiled.
PATIENCE, LONGEST = 4.0, 60.0

#: The one that asked last.
_last = [int(signal.SIGINT)]
#: How often it was asked since :func:`forget_signals`; whether :func:`_watch` waits for its end.
_asked, _watched = [0], [False]
#: Whether something runs in the main thread that is not to be interrupted.
_outer = [False]
#: How many things run that end by themselves before they answer, and when the last one ended.
_deferring, _deferred_until = [0], [0.0]
#: Whether this process is the command line's own, and may be ended by :func:`end_now`.
_own_process = [False]
#: What stops motors, for a process that has to be ended.
_stops: list[Callable[[], object]] = []


def own_process() -> None:
    """Say that this process is the command line's own: one that does not end in time is ended.

    Signals that come before :func:`answer_signals` end it at once: nothing has begun.
    """
    _own_process[0] = True
    for number in SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, lambda number, frame: end_now(number))
    # Python runs handlers between two of its own steps, and a compiler may take a minute for one.
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    if hasattr(os, "register_at_fork"):  # what a child is asked is not asked of this process
        os.register_at_fork(after_in_child=lambda: signal.set_wakeup_fd(-1))
    threading.Thread(target=_watch, args=(reader,), name="end", daemon=True).start()
    ignored = sys.unraisablehook

    def again(unraisable: Any) -> None:
        # Raised within a callback of compiled code (Numba's compiler), it came to nothing.
        if unraisable.exc_type is KeyboardInterrupt:
            threading.Timer(0.05, os.kill, (os.getpid(), _last[0])).start()
        else:
            ignored(unraisable)

    sys.unraisablehook = again


def asked_to_end() -> bool:
    """Return whether something asked this program to end, answered or not."""
    return _asked[0] > 0


def forget_signals() -> None:
    """Take what was asked so far for answered, as by a program that Ctrl-C ends as it should."""
    _asked[0], _watched[0] = 0, False


def ended_as_usual() -> None:
    """Answer Ctrl-C where it is the way to end a program; other signals still interrupt it."""
    if _last[0] == signal.SIGINT:
        forget_signals()


def ignore_signals() -> None:
    """Ignore what asks to end from now on: the process of the command line is ending."""
    if _own_process[0]:
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN)


@contextmanager
def stopped_at_end(stop: Callable[[], object]) -> Iterator[None]:
    """Have motors stopped by ``stop`` should the process have to be ended meanwhile."""
    _stops.append(stop)
    try:
        yield
    finally:
        _stops.remove(stop)


def end_now(number: int) -> None:
    """End this process at once, as the signal asks; motors are stopped as far as they can be."""
    for stop in list(_stops):
        thread = threading.Thread(target=_quietly, args=(stop,), daemon=True)
        thread.start()
        thread.join(1.0)
    with suppress(OSError):
        os.write(2, INTERRUPTED.encode() + b"\n")
    os._exit(128 + number)


#: What a program says that was interrupted.
INTERRUPTED = (
    "neurosim: interrupted; complete files can be read; if there is a checkpoint, run the "
    "command again with --resume"
)


def _quietly(stop: Callable[[], object]) -> None:
    with suppress(BaseException):
        stop()


def _note(number: int) -> None:
    """Note that a signal asked to end."""
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
    """Return whether Numba compiles something: that takes long, and ending it loses nothing."""
    module = sys.modules.get("numba.core.compiler_lock")
    if module is None:
        return False
    lock = module.global_compiler_lock._lock  # its own is_locked() asks about this thread alone
    free = lock.acquire(blocking=False)
    if free:
        lock.release()
    return not free


def answer_signals() -> None:
    """Have what asks this program to end raise KeyboardInterrupt.

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
    Signals that are ignored (``nohup``, a shell's background) stay ignored.

    Raises:
        KeyboardInterrupt: at the second one, also where it came out of compiled code wrapped.
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
    """Let what runs inside end before anything that asks the program to end is answered.

    For compiled code that runs on several cores, which does not survive an exception that is
    raised in the middle of it (:func:`deferred_interrupt` is for a whole generation). Signals that
    came meanwhile are answered at the end, by their former handler; the third is answered at once,
    for what runs inside may be anything. Within another one it does nothing: the outer one answers.
    Also a decorator.

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
    before = {number: handler for number, handler in handlers.items() if callable(handler)}
    for number in before:
        signal.signal(number, answer)
    return before


def _put_back(before: dict[int, Any]) -> None:
    for number, handler in before.items():
        signal.signal(number, handler)
