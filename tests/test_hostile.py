"""Datasets that a stranger made: they show no file of this machine, run nothing, and take no memory that they do not fill."""

import ast
import contextlib
import errno
import html.parser
import io
import json
import os
import re
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from dataset_factory import CAMERA, MICROPHONE, TASK, dataset_features, make_dataset
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets import LeRobotDatasetMetadata
from PIL import Image
from support.recording import edit_column, edit_info

from lerobot_playbyear.audio import write_audio
from lerobot_playbyear.audio.attach_audio import AttachAudioConfig, DatasetPlace, attach_audio
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.findings import worst
from lerobot_playbyear.datasets.reader import DatasetReader, SurveyedDataset
from lerobot_playbyear.datasets.survey import survey
from lerobot_playbyear.film.video import film_sound
from lerobot_playbyear.hub.dataset_card import describe_dataset
from lerobot_playbyear.hub.push import HubError, push_dataset
from lerobot_playbyear.inspection.inspect import InspectConfig, InspectDatasetConfig, inspect
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy
from lerobot_playbyear.repair.repair import RepairConfig, repair
from lerobot_playbyear.training import EpisodeStore

FILM = "observation.images.film"
SECRET = (250, 5, 120)  # a colour that no other picture has
EVIL = (
    "Lift <img src=x onerror=alert(1)> ![p](http://evil/p.png) | [l](http://evil)\n---\n# Head\n```\n"
    '`x` "; rm -rf ~; $(id) {{script}}'
)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Pictures in a column and in a film, sound, and numbers of more than one dimension, all of them believed."""
    root = tmp_path_factory.mktemp("made") / "set"
    features = dataset_features(image_size=16)
    features[FILM] = {**features[CAMERA], "dtype": "video"}
    features["observation.grid"] = {"dtype": "float32", "shape": (4, 5), "names": None}
    make_dataset(root, (6, 5), features=features)
    assert READERS["train"](root).column("observation.grid").shape == (11, 4, 5)
    return root


@pytest.fixture
def root(made, tmp_path):
    """A copy, beside a picture of this machine."""
    Image.new("RGB", (16, 16), SECRET).save(tmp_path / "secret.png")
    return Path(shutil.copytree(made, tmp_path / "set"))


def edit_frames(root: Path, key: str, change: Callable[[Any], Any]) -> None:
    """`change` gets the column's values, row by row."""
    (path,) = root.glob("data/*/*.parquet")
    edit_column(path, key, lambda values: [change(value) for value in values])


def picture(path: str | None = None, data: bytes | None = None) -> Callable[[Path], None]:
    return lambda root: edit_frames(root, CAMERA, lambda _: {"bytes": data, "path": path})


def encoded(image: Image.Image, kind: str) -> bytes:
    file = io.BytesIO()
    image.save(file, kind)
    return file.getvalue()


def rename_task(root: Path, text: str) -> None:
    tasks = pd.read_parquet(root / "meta/tasks.parquet").rename(index={TASK: text})
    tasks.to_parquet(root / "meta/tasks.parquet")


def rename_feature(root: Path, old: str, new: str) -> None:
    def rename(info):
        info["features"] = {new if key == old else key: value for key, value in info["features"].items()}

    edit_info(root, rename)
    for path in [*root.glob("data/*/*.parquet"), *root.glob("meta/episodes/*/*.parquet")]:
        table = pq.read_table(path)
        names = [
            re.sub(rf"^(stats/|)({re.escape(old)})(?=/|$)", lambda m: m[1] + new, name) for name in table.column_names
        ]
        pq.write_table(table.rename_columns(names).replace_schema_metadata({}), path)
    stats = json.loads((root / "meta/stats.json").read_text())
    (root / "meta/stats.json").write_text(json.dumps({new if key == old else key: v for key, v in stats.items()}))


# What reads a dataset. Each raises what it refuses, or names as an error


def looked(root: Path, **options: Any) -> None:
    findings = inspect(InspectConfig(InspectDatasetConfig("a/b", str(root)), **options))
    if worst(findings) == "error":
        raise ValueError("; ".join(map(str, findings)))


def checked(root: Path) -> None:
    found = survey(root)
    if not found.is_undamaged:
        raise ValueError(str(found))


def attached(root: Path) -> None:
    for episode in range(2):
        write_audio(root.parent / f"{episode}.wav", np.zeros(16000, np.int16), 16000)
    places = DatasetPlace("a/b", str(root)), DatasetPlace("a/c", str(root.parent / "copy"))
    attach_audio(AttachAudioConfig(*places, files=str(root.parent / "{episode}.wav"), microphone="new"))


READERS: dict[str, Callable[[Path], Any]] = {
    "train": lambda root: EpisodeStore.from_dataset(DatasetReader("a/b", str(root)), device="cpu"),
    "inspect": looked,
    "page": lambda root: looked(root, html=root.parent / "page.html"),
    "check": checked,
    "attach": attached,
    "push": lambda root: push_dataset("me/hostile", root),
}
ERRORS = {"train": (ValueError, OSError), "attach": InputError, "push": HubError}  # of the others ValueError
FILES_MADE = {"page": "page.html", "attach": "copy"}


# What is hostile


def link(name: str, target: str) -> Callable[[Path], None]:
    def make(root: Path) -> None:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).symlink_to(root / target)

    return make


def linked_picture(root: Path) -> None:
    link("images/link.png", "../secret.png")(root)
    picture("images/link.png")(root)


def elsewhere(name: str, place: str) -> Callable[[Path], None]:
    """A file or folder of the dataset lies at another place, and a link in its own."""

    def move(root: Path) -> None:
        (path,) = root.glob(name)
        path.rename(root / place)
        path.symlink_to(root / place)

    return move


def template(name: str, value: str) -> Callable[[Path], None]:
    return lambda root: edit_info(root, lambda info: info.update({name: value.replace("{root}", str(root.parent))}))


def path_as_file_number(root: Path) -> None:
    edit_info(root, lambda info: info.update(video_path="videos/{video_key}/{chunk_index}/{file_index}.mp4"))
    (path,) = root.glob("meta/episodes/*/*.parquet")
    table, name = pq.read_table(path).replace_schema_metadata({}), f"videos/{FILM}/file_index"
    outside = pa.array(["../../../../secret"] * len(table))
    pq.write_table(table.set_column(table.column_names.index(name), name, outside), path)
    (root / "videos" / FILM / "0").mkdir()
    shutil.copy(next(root.rglob("*.mp4")), root.parent / "secret.mp4")


def larger_film(root: Path) -> None:
    with av.open(str(next(root.rglob("*.mp4"))), "w") as film:
        stream = film.add_stream("libx264", rate=20)
        stream.width, stream.height = 640, 480
        for _ in range(11):
            film.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((480, 640, 3), np.uint8), "rgb24")))
        film.mux(stream.encode(None))


def missing_picture(root: Path) -> None:
    numbers = iter(range(11))
    edit_frames(root, CAMERA, lambda value: None if next(numbers) == 3 else value)


OUTSIDE, NO_PAGE = "outside its folder", r"No page is written.* is a link to .*--dataset\.root"
REPAIR = "playbyear-repair --root="
DAMAGED = r"file-000\.parquet.*playbyear-repair --root="
ELSEWHERE = "info.json: {}|not in its folder"
TEMPLATES = (
    ("video_path", "../other/{video_key}-{chunk_index}-{file_index}.mp4"),
    ("video_path", "{root}/{video_key}.mp4"),
    ("video_path", "videos/{video_key.__class__}/{file_index}.mp4"),
    ("data_path", "../other/{chunk_index}-{file_index}.parquet"),
    ("data_path", "data/{chunk_index:999999999d}.parquet"),
)
BOMB = encoded(Image.new("L", (12_000, 7_000)), "PNG")  # 100 kB, 250 MB when decoded as RGB
POSTSCRIPT = encoded(Image.new("RGB", (16, 16)), "EPS")
OTHER_SIZE = rf"'{FILM}': .*file-000.mp4' have 640 x 480 pixels; .*\(16, 16, 3\)"

# What is done to the dataset, and what each reader says of it; None: it reads on
HOSTILE: dict[str, tuple[Callable[[Path], object], dict[str, str | None]]] = {
    "picture: parent": (
        picture("../secret.png"),
        {"train": OUTSIDE, "inspect": OUTSIDE, "page": OUTSIDE, "push": r"Not pushed.*outside"},
    ),
    "picture: absolute": (
        lambda root: picture(str(root.parent / "secret.png"))(root),
        {"train": OUTSIDE, "inspect": OUTSIDE, "page": OUTSIDE, "push": r"Not pushed.*outside"},
    ),
    "picture: link": (
        linked_picture,
        {"train": OUTSIDE, "inspect": OUTSIDE, "page": NO_PAGE, "push": r"Not pushed.*outside"},
    ),
    "picture: PostScript": (
        picture(data=POSTSCRIPT),
        {"train": "cannot identify", "check": r"is damaged \(it is none\)"},
    ),
    "picture: bomb": (picture(data=BOMB), {"train": "12000 x 7000 pixels", "inspect": "12000 x 7000 pixels"}),
    "picture: missing": (missing_picture, {"train": f"'{CAMERA}': a picture is missing"}),
    "film: size": (larger_film, {"train": OTHER_SIZE, "inspect": "640 x 480"}),
    "film: number": (path_as_file_number, {"page": f"its pictures of '{FILM}' are lost"}),
    **{
        f"{name}: {value}": (template(name, value), dict.fromkeys(("train", "inspect"), ELSEWHERE.format(name)))
        for name, value in TEMPLATES
    },
    "camera's name": (lambda root: rename_feature(root, FILM, "../../secret"), {"inspect": "not in its folder"}),
    "table: more frames": (lambda root: edit_frames(root, "episode_index", lambda _: 1), {"attach": REPAIR}),
    "table: no number": (lambda root: edit_frames(root, "frame_index", lambda n: n or None), {"attach": DAMAGED}),
    "link: file": (
        link("videos/more/x.mp4", "../secret.png"),
        {"push": "Not pushed.*x.mp4' is a link to", "attach": "is a link to"},
    ),
    "link: folder": (link("meta/extra", ".."), {"push": "Not pushed.*extra' is a link to", "attach": "is a link to"}),
    **{
        f"link within: {part}": (
            elsewhere(part, "kept"),
            {"push": f"Not pushed.*{part}' is a link to a folder", "attach": "is a link to a folder"},
        )
        for part in ("data", "meta/episodes")
    },
    **{  # read as one's own, on another disk
        f"link away: {part}": (elsewhere(part, "../elsewhere"), {"page": NO_PAGE, "inspect": None, "train": None})
        for part in ("videos", "videos/*/*/*.mp4", "data")
    },
}


@pytest.mark.parametrize("what", HOSTILE)
def test_a_hostile_dataset_is_refused_by_whoever_reads_it(root, here, monkeypatch, what):
    """And nothing is uploaded, copied or written."""
    spoil, says = HOSTILE[what]
    spoil(root)
    monkeypatch.chdir(root / "meta")  # from where "../secret.png" is nothing: names are the dataset's
    for reader, said in says.items():
        if said is None:
            READERS[reader](root)
            continue
        with pytest.raises(ERRORS.get(reader, ValueError), match=f"(?s){said}"):
            READERS[reader](root)
        assert said == OUTSIDE or not (root.parent / FILES_MADE.get(reader, "nothing")).exists()
    assert not here.requests


def test_a_picture_in_a_file_of_the_dataset_is_read(root, tmp_path, monkeypatch):
    (root / "pictures").mkdir()
    shutil.copy(tmp_path / "secret.png", root / "pictures/one.png")
    picture("pictures/one.png")(root)
    monkeypatch.chdir(tmp_path)
    assert (READERS["train"](root).column(CAMERA)[0, :, 0, 0].numpy() == SECRET).all()
    dataset = SurveyedDataset.open("a/b", root)
    assert (next(dataset.pictures(CAMERA, dataset.episodes[0]))[0, 0] == SECRET).all()


def test_links_in_a_circle_and_pipes_hold_nobody_up(root, here, tmp_path):
    (root / "meta/loop").symlink_to("..")
    (root / "meta/self").symlink_to("self")
    os.mkfifo(root / "meta/pipe")
    push_dataset("me/hostile", root)
    names = here.dataset("me/hostile").files()
    assert "meta/info.json" in names
    assert not [name for name in names if "loop" in name or "self" in name or "pipe" in name]
    os.mkfifo(tmp_path / "endless.png")  # who reads it waits for ever
    picture(str(tmp_path / "endless.png"))(root)
    survey(root)


def test_a_folder_that_cannot_be_listed_is_an_error_of_the_upload(root, here, monkeypatch):
    listed = Path.iterdir

    def fail(folder):
        if folder.name == "notes":
            raise PermissionError(errno.EACCES, "Permission denied", str(folder))
        return listed(folder)

    (root / "notes").mkdir()
    monkeypatch.setattr(Path, "iterdir", fail)
    with pytest.raises(HubError, match=r"Not pushed.*Permission denied"):
        push_dataset("me/noise", root)
    assert not here.requests


def test_links_that_stay_at_home_are_read_through(root, tmp_path):
    """Those within the dataset, and those of the Hub's cache, whose files are links to its blobs."""
    (tmp_path / "link").symlink_to(root)
    elsewhere("videos", "kept")(root)
    READERS["page"](tmp_path / "link")
    (root / "videos").unlink()
    (root / "kept").rename(root / "videos")
    cache = tmp_path / "hub/datasets--a--b"
    snapshot = cache / "snapshots/abc"
    (cache / "blobs").mkdir(parents=True)
    for number, path in enumerate([path for path in root.rglob("*") if path.is_file()]):
        place = snapshot / path.relative_to(root)
        place.parent.mkdir(parents=True, exist_ok=True)
        path.rename(cache / "blobs" / str(number))
        place.symlink_to(os.path.relpath(cache / "blobs" / str(number), place.parent))
    READERS["page"](snapshot)
    READERS["attach"](snapshot)


# Names and texts


class _Markup(html.parser.HTMLParser):
    """What a browser makes of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)


def test_the_page_shows_names_as_they_are_and_a_report_commands_no_terminal(root, tmp_path, capsys):
    rename_task(root, EVIL + "</script><script>alert(1)</script><!-- episodes -->")
    rename_feature(root, MICROPHONE, "observation.audio.\x1b]0;owned\x07\x1b[2J")
    name = "a/{{script}}{{style}}{{policy}}<b>"
    inspect(InspectConfig(InspectDatasetConfig(name, str(root)), html=tmp_path / "page.html"))
    text = (tmp_path / "page.html").read_text()
    assert "<title>a/{{script}}{{style}}{{policy}}&lt;b&gt;</title>" in text
    assert text.count('"use strict"') == 1
    tags = _Markup(text).tags
    assert (tags.count("b"), tags.count("script")) == (0, 2 * 2 + 2)  # of each episode; of all, the page's
    data = json.loads(re.search(r'id="dataset">(.*?)</script>', text)[1])
    assert data["episodes"][0]["task"].startswith(EVIL)
    out = capsys.readouterr().out
    assert "owned" in out
    assert not {"\x1b", "\x07"} & set(out)


def assert_harmless(card: str, head: int = 0) -> None:
    """What Markdown's rules make of a card: no HTML, no link, no picture, no heading or block that a stranger made."""
    assert card.count("\n---\n") == head
    assert "# Head" not in [line.strip() for line in card.splitlines()]
    rest = re.sub(r"^```.*?^```$", "", card, flags=re.DOTALL | re.MULTILINE)  # blocks of code
    rest = re.sub(r"(`+)(?!`).*?(?<!`)\1(?!`)", "", rest)  # and code in a line
    assert not re.search(r"(?<!\\)(<img src=x|<b>|\]\(http://evil|://evil|!\[p)", rest)


def test_a_name_forges_no_line_of_a_report(root, capsys):
    edit_info(root, lambda info: info["features"].update({"a\n  - all is well": info["features"]["action"]}))
    (line,) = (line for line in str(survey(root)).splitlines() if "all is well" in line)
    assert "columns are not the dataset's features: a\\n  - all is well" in line
    looked_at = repair(RepairConfig(root, dry_run=True))
    assert len(capsys.readouterr().out.splitlines()) == 1 + len(looked_at.survey.findings)


def test_the_card_of_a_dataset_shows_names_as_they_are(root):
    rename_task(root, EVIL)
    microphone = 'observation.audio.a`<img src=x>|"\n```\n# Head'
    rename_feature(root, MICROPHONE, microphone)
    edit_info(root, lambda info: info.update(robot_type=EVIL))
    card = describe_dataset(SurveyedDataset.open("a/b", root), "me/hostile")
    assert_harmless(card)
    rows = [line for line in card.splitlines() if line.startswith("| ")]
    assert all(len(re.findall(r"(?<!\\)\|", row)) == 3 for row in rows), rows
    code = re.search(r"^```python\n(.*?)^```$", card, re.DOTALL | re.MULTILINE)[1]
    assert microphone in [node.value for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Constant)]
    edit_info(root, lambda info: info["features"][microphone]["info"].update(sample_rate="<b>abc"))
    card = describe_dataset(SurveyedDataset.open("a/b", root), "a/b")
    assert "abc" in card
    assert_harmless(card)


def test_the_card_of_a_policy_shows_names_as_they_are(root, here):
    rename_task(root, EVIL)
    edit_info(root, lambda info: info.update(robot_type=EVIL))
    features = {
        "observation.images.a`|<img src=x>": PolicyFeature(FeatureType.VISUAL, (3, 16, 16)),
        MICROPHONE: PolicyFeature(FeatureType.STATE, (800,)),
    }
    action = {"action": PolicyFeature(FeatureType.ACTION, (4,))}
    small = {"image_size": 16, "vision_width": 4, "hidden_size": 32, "device": "cpu", "sample_rate": 16000}
    policy = PlaybyearPolicy(PlaybyearConfig(input_features=features, output_features=action, **small))
    clean = SimpleNamespace(
        repo_id="a/b", total_episodes=1, total_frames=1, fps=20, robot_type="x", camera_keys=[],
        tasks=pd.DataFrame(index=["Lift"]),
    )  # fmt: skip
    usual = policy.generate_model_card("me/x", "playbyear", "mit", [], cfg=None, dataset_meta=clean)
    meta = LeRobotDatasetMetadata("a/b", root=root)
    card = policy.generate_model_card("me/x\n---\n# Head", "playbyear", "mit", [], cfg=None, dataset_meta=meta)
    assert_harmless(str(card).split("---\n", 2)[2], head=str(usual).count("\n---\n") - 1)
    assert "Lift" in card.text
    command = re.search(r"lerobot-rollout(.*?)```", card.text, re.DOTALL)[1]
    arguments = shlex.split(command.replace("\\\n", " "), comments=False)
    task = next(argument for argument in arguments if argument.startswith("--task="))
    assert "rm -rf" in task  # as a word of the task, and no command
    assert not {"$", "`"} & set(task)
    assert re.fullmatch(r"--robot\.type=[\w.-]+", next(a for a in arguments if a.startswith("--robot.type")))


# Memory


def cut_off(root: Path) -> None:
    """A data file without its end, as a killed recording leaves it."""
    (path,) = root.glob("data/*/*.parquet")
    path.write_bytes(path.read_bytes()[:-300])


def claim(info: dict[str, Any], kind: str) -> None:
    sound = info["features"][MICROPHONE]
    if kind in ("sound", "cut"):
        sound["shape"], sound["info"]["sample_rate"] = [400_000_000], 400_000_000 * info["fps"]
    elif kind == "state":
        info["features"]["observation.state"]["shape"] = [400_000_000]
    elif kind == "picture":
        info["features"][CAMERA]["shape"] = [100_000, 100_000, 3]
    elif kind == "fps":
        info["fps"], sound["info"]["sample_rate"] = 20_000_000, 800 * 20_000_000
    else:
        info["total_episodes"] = 50_000_000


def grown_by(work: Callable[[], object]) -> float:
    """How much more memory this process took meanwhile than before [MB]."""

    def kilobytes(name: str) -> int:
        return int(re.search(rf"{name}:\s*(\d+) kB", Path("/proc/self/status").read_text())[1])

    Path("/proc/self/clear_refs").write_text("5")  # the peak begins again
    before = kilobytes("VmRSS")
    work()
    return (kilobytes("VmHWM") - before) / 1024


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="only Linux resets a peak")
@pytest.mark.parametrize("kind", ["sound", "cut", "state", "picture", "fps", "episodes"])
def test_claims_that_ask_for_gigabytes_get_none(root, kind):
    if kind == "cut":
        cut_off(root)
    edit_info(root, lambda info: claim(info, kind))

    def read(reader: str) -> None:
        may_be_read = reader == "check" or kind == "picture"
        said = pytest.raises(ValueError, match=r"info\.json|playbyear-repair")
        with contextlib.suppress(MemoryError, ValueError) if may_be_read else said:
            READERS[reader](root)

    for reader in ("train", "inspect", "check"):
        assert grown_by(lambda reader=reader: read(reader)) < 150


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="only Linux resets a peak")
def test_large_pictures_are_decoded_one_at_a_time(tmp_path):
    """Black ones of 12 million pixels fill 40 kB, and 36 MB each once they are read."""
    root, size = tmp_path / "set", 3464
    make_dataset(root, (8,), image_size=16, microphones=())
    picture(data=encoded(Image.new("RGB", (size, size)), "PNG"))(root)
    edit_info(root, lambda info: info["features"][CAMERA].update(shape=[size, size, 3]))
    dataset = SurveyedDataset("a/b", survey(root, thorough=False))
    pictures = dataset.pictures(CAMERA, dataset.episodes[0])
    assert grown_by(lambda: next(pictures)) < 220  # all of them: 350


def test_a_rate_without_a_common_divisor_takes_no_gigabytes():
    rate = 44_101
    sound = [np.ones(2 * rate, np.int16)] * 2
    heard = []
    assert grown_by(lambda: heard.append(film_sound(sound, 2, 1, gain=1.0))) < 300
    samples, higher = heard[0]
    assert (higher, len(samples)) == (48_000, pytest.approx(96_000, abs=100))
