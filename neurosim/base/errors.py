"""Errors that a user can cause, each one clear sentence for stderr; and words for messages."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path


def counted(count: int, noun: str) -> str:
    """Return a number of things in words, such as ``1 sample`` or ``2 samples``."""
    return f"{count} {noun}" + "s" * (count != 1)


class UserError(Exception):
    """An error that a user can correct: one sentence says what is wrong, where, and what to do.

    The command line prints the message alone and exits with 1; callers of the library catch it like
    any exception.

    Example:
        >>> try:
        ...     ns.load("nowhere")
        ... except ns.UserError as error:
        ...     print(error)
        nowhere: is not a simulator, controller or dataset: no such folder
    """


def unwritten(owner: object, method: str) -> UserError:
    """Return the error for a user's own class that lacks a method."""
    return UserError(f"{type(owner).__name__} has no method {method}(): write one")


def check_names(owner: str, names: Iterable[str], known: Sequence[str]) -> None:
    """Raise an error for settings with unknown names.

    Raises:
        UserError: with the first unknown name, and the known ones.
    """
    for name in names:
        if name not in known:
            raise UserError(f"{owner} has no setting {name!r}; it has {', '.join(known) or 'none'}")


class FileError(UserError):
    """A file that is missing, of another format or version, cut short, or wrong in one place."""

    def __init__(
        self,
        path: str | Path,
        what: str,
        *,
        line: int | None = None,
        field: str | None = None,
    ):
        where = str(path)
        if line is not None:
            where += f", line {line}"
        if field is not None:
            where += f", field {field!r}"
        super().__init__(f"{where}: {what}")
        self.path = Path(path)
        self.line = line
        self.field = field


class RobotError(UserError):
    """No robot was found, another device answered, or the robot stopped answering."""


class LinkLost(RobotError):
    """The robot answered before and no longer does; what was recorded stays readable."""
