"""How the package is laid out: who imports whom, where modules lie, and how long they are."""

import ast
import io
import tokenize
from collections.abc import Iterator
from pathlib import Path

_ROOT = Path(__file__).parents[1] / "lerobot_playbyear"

# Each package, and what it may import in addition to itself and `compat`. A package names only those above it: no circles.
_ARROWS = """
datasets
audio           datasets
microphones     datasets audio
repair          datasets audio
policy          datasets audio
episodes        datasets audio
film            datasets audio episodes
inspection      datasets audio film
hub             datasets audio policy film inspection
training        datasets audio policy hub
teleoperation   datasets episodes
recording       datasets episodes hub teleoperation
dagger          datasets policy episodes hub training
reproduce       datasets policy episodes film training recording dagger
scripts
"""
_ALLOWED = {package: others for package, *others in map(str.split, _ARROWS.strip().splitlines())}
_ALLOWED["scripts"] = [package for package in _ALLOWED if package != "scripts"]
_AT_THE_TOP = {"__init__.py", "compat.py"}
_TOP_NAMES = {"compat", "lazy_names", "__version__"}
"""What every package may import from the top."""

_MOST_LINES, _FEWEST_LINES = 400, 25
_SHORT = {
    "datasets/errors.py": "the error that all of the package raise; whoever catches it needs none of the rest",
}


def modules() -> dict[str, str]:
    """The text of every module, by its path in the package."""
    return {path.relative_to(_ROOT).as_posix(): path.read_text() for path in sorted(_ROOT.rglob("*.py"))}


def imported(text: str) -> Iterator[str]:
    """The parts of `lerobot_playbyear` that a module imports, wherever in it the import stands."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports name the whole path"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        parts = [name.split(".") for name in names]
        yield from (path[1] for path in parts if path[0] == _ROOT.name and len(path) > 1)


def forbidden(path: str, text: str) -> list[str]:
    """What a module imports against the arrows."""
    package = path.split("/")[0] if "/" in path else ""
    allowed = {package, *_TOP_NAMES, *_ALLOWED.get(package, [])} if package else set()
    return [f"{path} imports {other}" for other in sorted(set(imported(text))) if other not in allowed]


def test_no_package_imports_one_that_stands_below_it():
    packages = list(_ALLOWED)
    for index, package in enumerate(packages):
        assert set(_ALLOWED[package]) <= set(packages[:index]), f"{package}: the table itself goes in circles"
    wrong = [line for path, text in modules().items() for line in forbidden(path, text)]
    assert not wrong, "\n".join(wrong)


def test_every_module_lies_in_a_package_of_the_table():
    places = {path.split("/")[0] if "/" in path else path for path in modules()}
    assert places - _AT_THE_TOP <= set(_ALLOWED)


def n_code_lines(text: str) -> int:
    """Those that hold more than a comment or a docstring."""
    ends = (tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER, tokenize.COMMENT)
    tokens = [token for token in tokenize.generate_tokens(io.StringIO(text).readline) if token.type not in ends]
    texts = [node.value for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Expr)]
    prose = [range(node.lineno, (node.end_lineno or 0) + 1) for node in texts if isinstance(node, ast.Constant)]
    lines = {line for token in tokens for line in range(token.start[0], token.end[0] + 1)}
    return len(lines.difference(*prose))


def test_no_module_is_too_long_to_be_read_nor_too_short_to_be_one():
    long = {path: n for path, text in modules().items() if (n := n_code_lines(text)) > _MOST_LINES}
    lengths = {path: len(text.splitlines()) for path, text in modules().items()}
    short = {path: n for path, n in lengths.items() if n < _FEWEST_LINES and not path.endswith("__init__.py")}
    assert not long
    assert not set(short) - set(_SHORT), short
