"""Errors that a user can cause, each one clear sentence for stderr; and words of sentences."""

from __future__ import annotations

from pathlib import Path


def counted(count: int, noun: str) -> str:
    """Return a number of things in words, such as ``1 sample`` or ``2 samples``."""
    return f"{count} {noun}" + "s" * (count != 1)


class UserError(Exception):
    """Something a user can put right: what is wrong, where, and what to do, in one sentence.

    The command line prints the message alone and exits with 1; library callers catch it as
    any exception.

    Example:
        >>> try:
        ...     ns.load("nowhere")
        ... except ns.UserError as error:
        ...     print(error)
        nowhere: is not a simulator, controller or dataset: no such folder
    """


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
    """No robot found, the wrong thing on the line, or a robot that stopped answering."""


class LinkLost(RobotError):
    """The robot answered before and no longer does; what was recorded stays readable."""
