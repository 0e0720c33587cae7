"""Command lines, read without a parser: LeRobot's takes ten seconds to import."""

from collections.abc import Sequence


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


def with_long_store(args: Sequence[str]) -> list[str]:
    """`--store=disk`, or `--store disk`, as the parser knows it: `--store.place=disk`."""
    rest, long = list(args), []
    while rest:
        name, has_value, value = rest.pop(0).partition("=")
        if name == "--store" and not has_value and rest and not rest[0].startswith("--"):
            value = rest.pop(0)
        is_short = name == "--store" and value and not value.endswith((".json", ".yaml"))
        long.append(f"--store.place={value}" if is_short else name + has_value + value)
    return long
