"""An extension of Griffe: what the docstrings have that Markdown has not."""

from __future__ import annotations

import re
from typing import Any

import griffe

#: ``:class:`~package.module.Name``` -> `Name`.
ROLE = re.compile(r":\w+:`~?(?:[\w.]*\.)?([^`]*)`")


class Docstrings(griffe.Extension):
    """Roles become code; examples become sections; a block of code begins after a colon."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is not None:
            text = ROLE.sub(r"`\1`", obj.docstring.value)
            text = re.sub(r"^Example:$", "Examples:", text, flags=re.MULTILINE)
            obj.docstring.value = re.sub(r"::$", ":", text, flags=re.MULTILINE)
