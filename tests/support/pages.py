"""The commands of a Markdown page, as tests run them: as they stand there, made small by other numbers.

    blocks(page, "python")                            the text of each block that begins with ```python
    commands_of(page, {"--steps": 2})                 the commands of its ```bash blocks, each a list of words
    run_page(commands.succeed, page, {"--steps": 2})  runs them one after the other in the current folder

A replacement is an option and its value in all commands that have it: `{"--dataset.num_episodes": 2}`. A number takes the place
of a number only. What a machine has, such as a robot's devices, is text, `{"--robot.port": "/dev/null"}`, or for all options
that begin alike a list of words, `{"--robot.*": ["--robot.type=playbyear_sim", ...]}`, which every command gets that has such
options. A replacement that nothing on the page has is an error.
"""

import re
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]

Value = float | str | Sequence[str]


def blocks(page: Path, language: str = "bash") -> list[str]:
    """The text of a page's fenced blocks of a language, which may be indented, as in a list."""
    found = re.findall(rf"^( *)```{language}\n(.*?)^\1```", page.read_text(), re.DOTALL | re.MULTILINE)
    return [re.sub(f"^{indent}", "", text, flags=re.MULTILINE) for indent, text in found]


def commands_of(page: Path, replacements: Mapping[str, Value] | None = None) -> list[list[str]]:
    """The commands of a page's blocks of `bash`, each as its words. `a && b` are two; comments are left out."""
    lines = [line for block in blocks(page) for line in _lines(block.replace("\\\n", " "))]
    replaced = [_replaced(words, replacements or {}) for line in lines for words in _split(line)]
    assert replaced, f"{page.name} has no block of bash"
    unused = set(replacements or ()).difference(*(used for _, used in replaced))
    assert not unused, f"nothing in {page.name} has {', '.join(sorted(unused))}"
    return [words for words, _ in replaced]


def run_page(
    run: Callable[..., Any],
    page: Path,
    replacements: Mapping[str, Value] | None = None,
    own: Mapping[str, Callable[..., Any]] | None = None,
) -> list[Any]:
    """Run a page's commands, one after the other, in the current folder; what each gave.

    Args:
        run: `run(*words, environment=...)`, such as `commands.succeed`; the environment is what the page exported so far.
        page: The page.
        replacements: What makes its commands small.
        own: Programs that `run` does not know, `{"pip": installs}`, each called with its words.
    """
    environment: dict[str, str] = {}
    results = []
    for name, *words in commands_of(page, replacements):
        if name == "export":
            environment |= dict(word.split("=", 1) for word in words)
        elif own and name in own:
            results.append(own[name](*words))
        else:
            results.append(run(name, *words, environment=environment))
    return results


def installs(*words: str) -> None:
    """`pip install` of folders of this repository: whether there is something to install in each."""
    assert words[0] == "install"
    for folder in words[1:]:
        assert (ROOT / folder / "pyproject.toml").is_file(), folder


def _lines(text: str) -> Iterator[str]:
    """Lines of shell; what is quoted may go over several."""
    begun = ""
    for line in text.splitlines():
        begun += line
        try:
            shlex.split(begun, comments=True)
        except ValueError:  # a quotation is open
            begun += "\n"
            continue
        yield begun
        begun = ""
    assert not begun, f"a quotation is not closed: {begun}"


def _split(line: str) -> Iterator[list[str]]:
    lexer = shlex.shlex(line, posix=True, punctuation_chars="&|;<>")
    lexer.whitespace_split = True
    words: list[str] = []
    for word in [*lexer, "&&"]:
        if word == "&&":
            if words:
                yield words
            words = []
            continue
        assert not set(word) <= set("&|;<>"), f"{word!r} in {line!r}: tests run a page's commands without a shell"
        words.append(word)


def _replaced(words: Sequence[str], replacements: Mapping[str, Value]) -> tuple[list[str], set[str]]:
    """A command with its replacements, and which of them it has."""
    result: list[str] = []
    used: set[str] = set()
    for word in words:
        option, _, old = word.partition("=")
        pattern = next((pattern for pattern in replacements if fnmatch(option, pattern)), None)
        new = word if pattern is None else replacements[pattern]
        if isinstance(new, int | float):
            float(old)  # raises ValueError for what is no number
        if pattern is None:
            result.append(word)
        elif isinstance(new, int | float | str):
            result.append(f"{option}={new}")
        elif pattern not in used:
            result += new
        used |= {pattern} if pattern else set()
    return result, used
