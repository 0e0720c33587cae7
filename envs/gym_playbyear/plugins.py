"""Tasks, arms, props, materials and microphones by name: ours, and those that other distributions bring.

A distribution adds to a kind by an entry point of the group `gym_playbyear.<kind>`, in its `pyproject.toml`:

    [project.entry-points."gym_playbyear.tasks"]
    "StopAtTheTin-v1" = "my_package.stop_at_the_tin:stop_at_the_tin"

Nothing of it is imported before somebody asks for that name, so that one that is broken breaks no other.
"""

import importlib
from collections.abc import Iterator, Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import Any

GROUP = "gym_playbyear"
KINDS = ("tasks", "arms", "props", "materials", "microphones")


class PluginError(RuntimeError):
    """What another distribution names cannot be loaded."""


class Registry(Mapping[str, Any]):
    """The things of one kind by name. Ours come first: no other distribution replaces them.

    Args:
        kind: One of `KINDS`.
        own: Ours; a string is `module:attribute`, and is imported when it is asked for.

    Raises:
        KeyError: From `[name]`, with the names that are known.
        PluginError: From `[name]`, when another distribution's cannot be loaded.
    """

    def __init__(self, kind: str, own: Mapping[str, Any]):
        self.kind, self._own = kind, own

    def __iter__(self) -> Iterator[str]:
        yield from self._own
        yield from (name for name in self._others() if name not in self._own)

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __contains__(self, name: object) -> bool:
        return name in self._own or name in self._others()

    def __getitem__(self, name: str) -> Any:
        if name in self._own:
            found = self._own[name]
            return _imported(found) if isinstance(found, str) else found
        point = self._others().get(name)
        if point is None:
            raise KeyError(f"{name!r} is none of the {self.kind}: choose one of {', '.join(self)}.")
        try:
            return point.load()
        except Exception as error:
            owner = point.dist.name if point.dist else "another distribution"
            raise PluginError(
                f"{name!r} of {owner} ({self.kind}, {point.value}) cannot be loaded: {type(error).__name__}: {error}. "
                "Mend or uninstall that distribution, or choose another."
            ) from error

    def checked[T](self, name: str, kind: type[T]) -> T:
        """What has this name, of the class that it must have.

        Raises:
            ValueError: Nothing has this name, or it is of another class; the message says what to do.
            PluginError: Another distribution's cannot be loaded.
        """
        if name not in self:
            noun = self.kind.removesuffix("s").capitalize()
            raise ValueError(f"{noun} '{name}' is not known: choose one of {', '.join(sorted(self))}.")
        found = self[name]
        if not isinstance(found, kind):
            raise ValueError(
                f"{name!r} of the entry points {GROUP}.{self.kind} is a {type(found).__module__}.{type(found).__qualname__}; "
                f"wanted a {kind.__module__}.{kind.__qualname__}."
            )
        return found

    def _others(self) -> dict[str, EntryPoint]:
        # Asked for anew each time: a distribution may be installed while a notebook runs.
        return {point.name: point for point in entry_points(group=f"{GROUP}.{self.kind}")}


def _imported(path: str) -> Any:
    module, attribute = path.split(":")
    return getattr(importlib.import_module(module), attribute)
