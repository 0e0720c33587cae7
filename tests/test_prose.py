"""The prose of pages, help, options and messages: no word that stops a reader, no endless sentence, no figure of its own."""

import re
from pathlib import Path

import pytest

from lerobot_playbyear.reproduce.table import Table

ROOT = Path(__file__).parents[1]
CODE = ("lerobot_playbyear", "lerobot_policy_playbyear", "envs", "examples", "tools", "benchmarks")
PAGES = [*ROOT.glob("*.md"), *sorted((ROOT / "docs").rglob("*.md"))]
TEXTS = [
    *PAGES,
    *(path for folder in CODE for kind in ("md", "py", "sh", "txt") for path in (ROOT / folder).rglob(f"*.{kind}")),
]
SHORT = [ROOT / "README.md", *sorted((ROOT / "docs/tutorials").glob("*.md"))]
SHORT += [ROOT / f"docs/{name}.md" for name in ("index", "install", "troubleshooting", "glossary")]

STOPS = re.compile(
    r"\b(?:anew|shall|besides|today['’]s|formerly|hand-?overs?|(?:is|are) no options?|(?:preset|recipe)s? of (?:then|before)"
    r"|as it was then|no choice looked at|what is gone)\b",
    re.IGNORECASE,
)
_MOST_WORDS = 35


@pytest.mark.parametrize("folder", ["pages", *CODE])
def test_no_word_stops_a_reader(folder):
    """In pages, docstrings, comments, options, help and messages alike."""
    texts = PAGES if folder == "pages" else [path for path in TEXTS if path.is_relative_to(ROOT / folder)]
    assert texts
    found = [
        f"{path.relative_to(ROOT)}:{number}: {word}"
        for path in texts
        for number, line in enumerate(path.read_text().splitlines(), 1)
        for word in STOPS.findall(line)
    ]
    assert found == []


def sentences(page: str) -> list[str]:
    """Of a page in Markdown, without code, tables, pictures and the targets of links."""
    page = re.sub(r"^( *)(```|~~~).*?^\1\2|<!--.*?-->|^ *\|.*?$", "\n\n", page, flags=re.DOTALL | re.MULTILINE)
    page = re.sub(r"`[^`]*`|!\[[^\]]*\]\([^)]*\)|<[^>]*>", "", page)
    page = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", page)
    parts = re.split(r"\n\s*\n|^#+ .*$|^ *(?:[-*]|\d+\.) ", page, flags=re.MULTILINE)
    return [
        " ".join(each.split()) for part in parts for each in re.split(r"(?<=[.!?])[\"')*_]*\s+", part) if each.strip()
    ]


@pytest.mark.parametrize("page", SHORT, ids=[page.stem for page in SHORT])
def test_no_sentence_is_longer_than_35_words(page):
    found = [
        sentence for sentence in sentences(page.read_text()) if len(re.findall(r"\w[\w'’-]*", sentence)) > _MOST_WORDS
    ]
    assert found == []


def test_the_pages_stay_short():
    words = {str(page.relative_to(ROOT)): len(page.read_text().split()) for page in PAGES}
    assert words.pop("README.md") <= 900
    assert words.pop("CHANGELOG.md") <= 300
    assert words.pop("docs/learning_log.md") <= 18_000
    pages = {page: n for page, n in words.items() if page.startswith("docs/") and page != "docs/reference/options.md"}
    assert sum(pages.values()) <= 20_000, pages


def test_a_long_sentence_and_a_word_are_found():
    many = "word " * _MOST_WORDS
    page = f"# {many}\n\nOne two. A {many}.\n```\n{many}\n```\n|{many}|\n"
    assert [len(each.split()) for each in sentences(page)] == [2, _MOST_WORDS + 2]  # the last is the full stop
    assert STOPS.findall("It shall begin anew; Shallow. The preset of then.") == ["shall", "anew", "preset of then"]


# Figures

TASKS = dict(
    zip(
        ("Occluded Grasp", "Occluded Pick and Place", "Tell Apart", "Key Bag, Easy", "Key Bag, Hard"),
        ("OccludedGrasp-v1", "OccludedPickPlace-v1", "TellApart-v1", "KeyBag-Easy-v1", "KeyBag-Hard-v1"),
        strict=True,
    )
)
_TRAINED = {
    "full policy": ("offline", "no_interventions"),
    "deaf policy": ("offline", "no_interventions-no_audio"),
    "100 demonstrations, 2,500 updates": ("twice", "no_interventions"),
}
COLUMNS = (*_TRAINED, "best blind script", "expert")


def committed() -> dict[tuple[str, str], int]:
    """Success [%] by task and by who acts, from the tables in results/."""
    rows, figures = Table(ROOT / "results").rows("cpu"), {}
    for name, task in TASKS.items():
        for column, (study, variant) in _TRAINED.items():
            own = [row for row in rows if (row["study"], row["task"], row["variant"]) == (study, task, variant)]
            if successes := "".join(row["successes"] for row in own):
                figures[name, column] = round(100 * successes.count("1") / len(successes))
        (scripts,) = (row["players"] for row in rows if (row["task"], row["variant"]) == (task, "blind_scripts"))
        shares = {player: 100 * each["successes"] / each["n_episodes"] for player, each in scripts.items()}
        figures[name, "expert"] = round(shares.pop("expert"))
        figures[name, "best blind script"] = round(max(shares.values()))
    return figures


def shown(page: Path) -> dict[tuple[str, str], int]:
    """The same from a page's table of the tasks, which may be its rows or its columns."""
    cells: dict[tuple[str, str], int] = {}
    head: list[str] = []
    for line in page.read_text().splitlines():
        row = [re.sub(r"\*", "", cell).strip() for cell in line.split("|")[1:-1]]
        if not row or len(row) != len(head):
            head = row
            continue
        for column, cell in zip(head[1:], row[1:], strict=True):
            for place in ((row[0], column), (column, row[0])):
                if place[0] in TASKS and place[1] in COLUMNS and (figure := re.match(r"\d+(?= %)", cell)):
                    cells.setdefault(place, int(figure[0]))
    return cells


@pytest.mark.parametrize("page", ["README.md", "docs/results.md"])
def test_the_table_of_results_has_the_committed_figures(page):
    assert shown(ROOT / page) == committed()


def test_the_messages_in_troubleshooting_are_those_of_the_code():
    code = " ".join(path.read_text() for folder in CODE[:3] for path in (ROOT / folder).rglob("*.py"))
    code = re.sub(r"\"\s+f?\"|\{[^{}]*\}", "", code)  # each message in one piece, without its values
    table = re.findall(
        r"^\| (`.*?`) \|",
        (ROOT / "docs/troubleshooting.md").read_text().replace("observation.audio.", ""),
        re.MULTILINE,
    )
    theirs = {"Could not load libtorchcodec", "Device unavailable", "Invalid sample rate"}  # LeRobot's and PortAudio's
    parts = {part.strip(" .'") for cell in table for said in re.findall("`(.+?)`", cell) for part in said.split("...")}
    assert len(parts) > 25
    assert [part for part in sorted(parts - theirs) if part not in code] == []
