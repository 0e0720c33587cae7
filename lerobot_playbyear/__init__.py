"""Teaches LeRobot to hear. To import this package imports neither LeRobot nor torch."""

import importlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

__version__ = "0.1.0"


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
