"""Objects by name: neurosim's own, other packages' (entry points), and a script's (one call)."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from operator import attrgetter
from typing import Any

from neurosim.base.errors import UserError, check_names

#: The names of modules that are files named on the command line begin with this.
PLUGIN = "neurosim_plugin_"


class Registry:
    """The named objects of one kind, such as tasks.

    A name is searched among the registered objects, then among neurosim's own, then among the entry
    points of installed packages in the group ``neurosim.<plural>``.

    Attributes:
        what: the kind in the singular, for messages.
        group: of the entry points.
    """

    def __init__(self, what: str, group: str, own: Mapping[str, str]):
        """Make a registry.

        Args:
            what: the kind in the singular, for messages.
            group: of the entry points.
            own: name -> ``module:attribute``, imported at its first use.
        """
        self.what, self.group = what, group
        self._own = dict(own)
        self._registered: dict[str, Any] = {}

    def register(self, name: str, item: Any = None) -> Any:
        """Register an object under a name, which then works everywhere. Also a decorator.

        Raises:
            UserError: if an object of neurosim has the name.
        """
        if name in self._own:
            raise UserError(f"the name {name!r} is taken by neurosim's own {self.what}")
        if item is None:

            def add(item: Any) -> Any:
                self._registered[name] = item
                return item

            return add
        self._registered[name] = item
        return item

    def names(self) -> list[str]:
        """Return all names, neurosim's own first."""
        others = {*self._registered, *self._points()} - set(self._own)
        return [*self._own, *sorted(others)]

    def is_own(self, name: str) -> bool:
        """Return whether the name is one of neurosim's own."""
        return name in self._own

    def get(self, name: str, others: Sequence[str] = ()) -> Any:
        """Return the object of this name.

        Args:
            name: the name.
            others: names of other possible choices, for the message.

        Raises:
            UserError: if the name is unknown, or its package cannot be imported.
        """
        if name in self._registered:
            return self._registered[name]
        if name in self._own:
            module, _, attribute = self._own[name].partition(":")
            return attrgetter(attribute)(import_module(module))
        point = self._points().get(name)
        if point is None:
            names = ", ".join([*others, *self.names()])
            choices = f"choose from {names}" if names else "none is registered"
            raise UserError(f"there is no {self.what} {name!r}; {choices}")
        try:
            return point.load()
        except Exception as error:
            raise UserError(
                f"the {self.what} {name!r} ({point.value}) does not load: {error}"
            ) from None

    def make(self, name: str, settings: Mapping[str, Any]) -> Any:
        """Call the object of this name with settings as keywords; return it if it is not callable.

        Raises:
            UserError: if the name is unknown, or the object does not accept the settings.
        """
        maker: Callable[..., Any] = self.get(name)
        if not callable(maker) and not settings:
            return maker
        with suppress(TypeError, ValueError):  # not callable, or compiled
            taken = inspect.signature(maker).parameters.values()
            if not any(each.kind is each.VAR_KEYWORD for each in taken):
                check_names(f"the {self.what} {name}", settings, [each.name for each in taken])
        try:
            return maker(**settings)
        except TypeError as error:
            given = ", ".join(map(repr, settings)) or "none"
            raise UserError(
                f"the {self.what} {name} does not take these settings ({given}): {error}"
            ) from None

    def _points(self) -> dict[str, EntryPoint]:
        return _points_of(self.group, entry_points)


@cache
def _points_of(group: str, finder: Callable[..., Iterable[EntryPoint]]) -> dict[str, EntryPoint]:
    """Return the entry points of a group; finding them reads a file of every package."""
    return {point.name: point for point in finder(group=group)}
