"""Starting without LeRobot, whose import takes ten seconds: packages that import late, and command lines without a parser."""

import importlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any


def lazy_names(package: str, modules: Mapping[str, Sequence[str]]) -> Callable[[str], Any]:
    """A package's `__getattr__`, which imports a module when one of its names is first asked for.

    To import all that a package offers would import LeRobot and torch, ten seconds of work, also for those who need neither.

    Args:
        package: The package's `__name__`.
        modules: The names that each of its modules offers.
    """
    homes = {name: f"{package}.{module}" for module, names in modules.items() for name in names}

    def __getattr__(name: str) -> Any:  # noqa: N807 (Python's own name for it)
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(homes[name]), name)

    return __getattr__


def given_options(args: Sequence[str]) -> tuple[dict[str, str | None], list[str]]:
    """What a command line gives, as `--name=value` or `--name value`.

    Args:
        args: Without the command's own name.

    Returns:
        The value of every option, the first one where it is given twice, None where it has none; and what is no option.
    """
    options: dict[str, str | None] = {}
    strays: list[str] = []
    rest = list(args)
    while rest:
        name, has_value, value = rest.pop(0).partition("=")
        if not name.startswith("--"):
            strays.append(name + has_value + value)
        elif has_value or not rest or rest[0].startswith("--"):
            options.setdefault(name[2:], value if has_value else None)
        else:
            options.setdefault(name[2:], rest.pop(0))
    return options, strays
