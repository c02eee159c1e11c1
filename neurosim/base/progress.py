"""Progress of computations longer than two seconds, on stderr."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

from tqdm import tqdm

T = TypeVar("T")

#: Seconds between two lines of progress without a terminal.
LINE_EVERY = 10.0


class Progress:
    """A bar where stderr is a terminal; elsewhere a line every ten seconds.

    Nothing is shown in the first two seconds. Use as a context manager.
    """

    def __init__(self, label: str, total: float | None = None, unit: str = "it"):
        self.label = label
        self.total = total
        self.unit = unit
        self.done = 0.0
        self._note = ""
        self._started = self._last_line = time.monotonic()
        self._bar = None
        if sys.stderr.isatty():
            self._bar = tqdm(
                total=total, desc=label, unit=unit, delay=2.0, leave=False, dynamic_ncols=True
            )

    def advance(self, amount: float = 1.0, note: str = "") -> None:
        """Add to the count of finished items; ``note`` is a short figure to show next to it."""
        self.done += amount
        if self._bar is not None:
            if note and note != self._note:
                self._bar.set_postfix_str(note, refresh=False)
            self._bar.update(amount)
        else:
            now = time.monotonic()
            if now - self._last_line >= LINE_EVERY:
                self._last_line = now
                of_total = f" of {self.total:g}" if self.total else ""
                print(
                    f"{self.label}: {self.done:.0f}{of_total} {self.unit}, "
                    f"{now - self._started:.0f} s{', ' + note if note else ''}",
                    file=sys.stderr,
                    flush=True,
                )
        self._note = note

    def say(self, message: str) -> None:
        """Print a line to stderr without tearing the bar."""
        if self._bar is not None:
            self._bar.write(message, file=sys.stderr)
        else:
            print(message, file=sys.stderr, flush=True)

    def close(self) -> None:
        """Remove the bar."""
        if self._bar is not None:
            self._bar.close()

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def track(
    items: Iterable[T], label: str, total: int | None = None, unit: str = "it"
) -> Iterator[T]:
    """Iterate over ``items`` and show progress."""
    if total is None and hasattr(items, "__len__"):
        total = len(items)  # type: ignore[arg-type]
    with Progress(label, total, unit) as progress:
        for item in items:
            yield item
            progress.advance()
