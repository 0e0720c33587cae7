"""Tasks, materials and microphones by name: ours, and those that other distributions bring.

A distribution adds to a kind by an entry point of the group `gym_playbyear.<kind>`, in its `pyproject.toml`:

    [project.entry-points."gym_playbyear.tasks"]
    "StopAtTheTin-v1" = "my_package.stop_at_the_tin:stop_at_the_tin"

Nothing of it is imported before somebody asks for that name, so that one that is broken breaks no other.
"""

import importlib
import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from difflib import get_close_matches
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from gym_playbyear.task import Task, unknown_name

GROUP = "gym_playbyear"
KINDS = ("tasks", "materials", "microphones")


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
        # Asked for again each time: a distribution may be installed while a notebook runs.
        return {point.name: point for point in entry_points(group=f"{GROUP}.{self.kind}")}


def _imported(path: str) -> Any:
    module, attribute = path.split(":")
    return getattr(importlib.import_module(module), attribute)


class OptionError(ValueError):
    """An option is unknown, or has a value that cannot be used.

    Attributes:
        option: Its name.
        wanted: What would work, for messages that name option and value themselves.
    """

    def __init__(self, option: str, value: Any, wanted: str):
        super().__init__(f"{option}={value!r} is not known: {wanted}.")
        self.option, self.wanted = option, wanted


def check_option(name: str, value: Any, allowed: Iterable) -> None:
    """Raises OptionError if an option has none of the values that it may have."""
    allowed = tuple(allowed)
    if value not in allowed:
        raise OptionError(name, value, f"choose one of {', '.join(map(str, allowed))}")


def check_spelling(where: str, options: Mapping[str, Any], known: Iterable[str]) -> None:
    """Raises OptionError for one that is spelt nearly like one that is known: nobody is to think that it had an effect.

    Others pass: LeRobot's wrappers have options of their own.
    """
    for name, value in options.items():
        if name not in known and get_close_matches(name, known, n=1, cutoff=0.75):
            raise OptionError(f"{where} {name}", value, f"the task's options of reset are {', '.join(known)}")


def make_definition(task: str | Task | Callable[..., Task], options: Mapping[str, Any]) -> Task:
    """The task that a name, or a function, and options stand for.

    Args:
        task: A name, a task, or a function that makes one of its options.
        options: For that function.

    Raises:
        OptionError: No task has this name, or the task no such option, or not with this value.
        ValueError: The task is put together wrongly.
        PluginError: The task belongs to another distribution, which cannot be loaded.
    """
    from gym_playbyear import ALL_TASKS  # which itself needs `Registry`

    if isinstance(task, str) and task not in ALL_TASKS:
        raise OptionError("task", task, f"choose one of {', '.join(ALL_TASKS)}")
    named = ALL_TASKS[task] if isinstance(task, str) else task
    known = () if isinstance(named, Task) else tuple(inspect.signature(named).parameters)
    for name, value in options.items():
        if name not in known:
            has = f"its own options are {', '.join(known)}" if known else "it has none of its own"
            raise OptionError(name, value, f"{task if isinstance(task, str) else 'the task'} has no such option, {has}")
    definition = named if isinstance(named, Task) else named(**options)
    if not isinstance(definition, Task):
        raise OptionError("task", task, f"it gave a {type(definition).__name__}, wanted a gym_playbyear.task.Task")
    if not isinstance(named, Task):
        _check_twins(definition, known)
    return definition


def _check_twins(definition: Task, own: tuple[str, ...]) -> None:
    """Raises ValueError if twins differ by an option that neither the task's function has, `own`, nor the environment."""
    from gym_playbyear.environment import TaskEnv  # which itself needs `make_definition`

    known = {*own, *inspect.signature(TaskEnv).parameters} - {"task", "task_options"}
    for option in (option for world in definition.twins for option in world):
        if option not in known:
            raise unknown_name(f"{definition.name}: twins, option", option, known)
