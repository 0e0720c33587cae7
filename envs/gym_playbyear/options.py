"""From a task's name and options to the task."""

import inspect
from collections.abc import Callable, Iterable, Mapping
from difflib import get_close_matches
from typing import Any

from gym_playbyear import ALL_TASKS
from gym_playbyear.task import Task


class OptionError(ValueError):
    """An option is unknown, or has a value that cannot be used.

    Attributes:
        option: Its name.
        wanted: What would work, for messages that name option and value themselves.
    """

    def __init__(self, option: str, value: Any, wanted: str):
        super().__init__(f"{option}={value!r} is not known: {wanted}.")
        self.option, self.wanted = option, wanted


class ResetOptions(dict[str, Any]):
    """Options of `reset`, which know what a task's `place` asked for: nobody is to think that a misspelt one had an effect.

    Those of others, such as LeRobot's wrappers, pass.
    """

    def __init__(self, options: Mapping[str, Any]):
        super().__init__(options)
        self._asked: dict[str, None] = {}

    def __getitem__(self, name: str) -> Any:
        self._asked[name] = None
        return super().__getitem__(name)

    def __contains__(self, name: object) -> bool:
        self._asked[str(name)] = None
        return super().__contains__(name)

    def get(self, name: str, default: Any = None) -> Any:
        self._asked[name] = None
        return super().get(name, default)

    def check_spelling(self) -> None:
        """Raises OptionError for one that nobody asked for and that is spelt like one that was asked for."""
        for name in self.keys() - self._asked.keys():
            if get_close_matches(name, self._asked, n=1, cutoff=0.75):
                known = ", ".join(self._asked)
                raise OptionError(f"reset(options) {name}", self[name], f"the task's options of reset are {known}")


def check_option(name: str, value: Any, allowed: Iterable) -> None:
    """Raises OptionError if an option has none of the values that it may have."""
    allowed = tuple(allowed)
    if value not in allowed:
        raise OptionError(name, value, f"choose one of {', '.join(map(str, allowed))}")


def make_definition(task: str | Task | Callable[..., Task], options: Mapping[str, Any]) -> Task:
    """The task that a name, or a function, and options stand for.

    Args:
        task: A name, a task, or a function that makes one of its options.
        options: For that function.

    Raises:
        OptionError: No task has this name, or the task no such option, or not with this value.
        PluginError: The task belongs to another distribution, which cannot be loaded.
    """
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
    return definition
