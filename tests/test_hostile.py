"""Datasets that a stranger made: they show no file of this machine, run nothing, and take no memory that they do not fill."""

import ast
import errno
import html.parser
import io
import json
import os
import re
import resource
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from dataset_factory import CAMERA, MICROPHONE, TASK, dataset_features, make_dataset
from lerobot.datasets import LeRobotDatasetMetadata
from PIL import Image
from support.hub import HubServer

from lerobot_playbyear.audio import write_audio
from lerobot_playbyear.audio.attach_audio import AttachAudioConfig, AttachError, DatasetPlace, attach_audio
from lerobot_playbyear.datasets.info import check_links
from lerobot_playbyear.datasets.survey import survey
from lerobot_playbyear.film.video import at_a_rate_of_aac
from lerobot_playbyear.hub.dataset_card import describe_dataset
from lerobot_playbyear.hub.push import HubError, _files, push_dataset
from lerobot_playbyear.inspection.inspect import InspectConfig, InspectDatasetConfig, inspect
from lerobot_playbyear.inspection.source import DatasetSource, InspectionError
from lerobot_playbyear.training import EpisodeStore

SECRET = (250, 5, 120)  # a colour that no other picture has
EVIL = (
    "Lift <img src=x onerror=alert(1)> ![p](http://evil/p.png) | [l](http://evil)\n---\n# Head\n```\n"
    '`x` "; rm -rf ~; $(id) {{script}}'
)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    root = tmp_path_factory.mktemp("made") / "set"
    make_dataset(root, (6, 5), image_size=16)
    return root


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    root = tmp_path_factory.mktemp("filmed") / "set"
    make_dataset(root, (6, 5), image_size=16, use_videos=True)
    return root


@pytest.fixture
def root(made, tmp_path):
    shutil.copytree(made, tmp_path / "set")
    return tmp_path / "set"


@pytest.fixture
def videos(filmed, tmp_path):
    shutil.copytree(filmed, tmp_path / "set")
    return tmp_path / "set"


@pytest.fixture
def hub(monkeypatch):
    """A Hub on loopback."""
    with HubServer() as hub:
        monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", hub.url)
        monkeypatch.setattr("huggingface_hub.RepoCard.validate", lambda card: None)  # it asks huggingface.co
        yield hub


@pytest.fixture
def secret(tmp_path):
    """A picture of this machine, beside the dataset."""
    path = tmp_path / "secret.png"
    Image.new("RGB", (16, 16), SECRET).save(path)
    return path


def edit_info(root: Path, change) -> None:
    path = root / "meta" / "info.json"
    info = json.loads(path.read_text())
    change(info)
    path.write_text(json.dumps(info))


def edit_column(root: Path, key: str, change) -> None:
    """`change` gets the column's values, row by row."""
    (path,) = root.glob("data/*/*.parquet")
    table = pq.read_table(path)
    field = table.schema.field(key)
    values = pa.array([change(value) for value in table.column(key).to_pylist()], field.type)
    pq.write_table(table.set_column(table.column_names.index(key), field, values), path)


def point_to(root: Path, name: str) -> None:
    edit_column(root, CAMERA, lambda picture: {"bytes": None, "path": name})


def rename_task(root: Path, text: str) -> None:
    tasks = pd.read_parquet(root / "meta" / "tasks.parquet").rename(index={TASK: text})
    tasks.to_parquet(root / "meta" / "tasks.parquet")


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
    stats = json.loads((root / "meta" / "stats.json").read_text())
    (root / "meta" / "stats.json").write_text(json.dumps({new if key == old else key: v for key, v in stats.items()}))


def attach(root: Path, tmp_path: Path, files: str = "{episode}.wav") -> Path:
    places = DatasetPlace("a/b", str(root)), DatasetPlace("a/c", str(tmp_path / "copy"))
    return attach_audio(AttachAudioConfig(*places, files=files, microphone="new"))


def looked(root: Path, tmp_path: Path) -> tuple[list, str]:
    page = tmp_path / "page.html"
    return inspect(InspectConfig(InspectDatasetConfig("a/b", str(root)), html=page)), page.read_text()


@pytest.mark.parametrize("which", range(3), ids=["absolute", "parent", "link"])
def test_a_picture_outside_the_folder_is_shown_nowhere(root, secret, hub, tmp_path, monkeypatch, which):
    """Not by a reader, not by training, not on a page, and in no film that is pushed."""
    (root / "images").mkdir(exist_ok=True)
    (root / "images" / "link.png").symlink_to(secret)
    point_to(root, [str(secret), "../secret.png", "images/link.png"][which])
    monkeypatch.chdir(root / "meta")  # from where "../secret.png" is nothing: names are the dataset's
    source = DatasetSource.open("a/b", root)
    with pytest.raises(ValueError, match="outside its folder"):
        list(source.pictures(source.episodes[0], CAMERA))
    with pytest.raises(ValueError, match="outside its folder"):
        EpisodeStore.load("a/b", str(root), device="cpu")
    if which == 2:
        with pytest.raises(InspectionError, match="No page is written"):
            looked(root, tmp_path)
    else:
        (root / "images" / "link.png").unlink()
        looked(root, tmp_path)
    findings = inspect(InspectConfig(InspectDatasetConfig("a/b", str(root))))
    (finding,) = [each for each in findings if each.check == "pictures"]
    assert (finding.level, "outside its folder" in finding.message) == ("error", True)
    with pytest.raises(HubError, match=r"Not pushed.*outside"):
        push_dataset("me/hostile", root)
    assert not hub.requests


def test_a_picture_in_a_file_of_the_dataset_is_read(root, tmp_path, monkeypatch):
    (root / "pictures").mkdir()
    Image.new("RGB", (16, 16), SECRET).save(root / "pictures" / "one.png")
    point_to(root, "pictures/one.png")
    monkeypatch.chdir(tmp_path)
    assert (EpisodeStore.load("a/b", str(root), device="cpu").column(CAMERA)[0, :, 0, 0].numpy() == SECRET).all()
    source = DatasetSource.open("a/b", root)
    assert (next(source.pictures(source.episodes[0], CAMERA))[0, 0] == SECRET).all()


def test_only_pictures_are_read_as_pictures(root):
    postscript = io.BytesIO()
    Image.new("RGB", (16, 16), SECRET).save(postscript, "EPS")
    edit_column(root, CAMERA, lambda picture: {"bytes": postscript.getvalue(), "path": None})
    with pytest.raises(OSError, match="cannot identify"):
        EpisodeStore.load("a/b", str(root), device="cpu")
    assert f"episodes 0, 1: a picture of '{CAMERA}' is damaged (it is none)" in str(survey(root))


def test_a_picture_of_another_size_is_refused_before_it_is_decoded(root):
    bomb = io.BytesIO()
    Image.new("L", (12_000, 7_000)).save(bomb, "PNG")  # 100 kB, 250 MB when decoded as RGB
    edit_column(root, CAMERA, lambda picture: {"bytes": bomb.getvalue(), "path": None})
    with pytest.raises(ValueError, match="12000 x 7000 pixels"):
        EpisodeStore.load("a/b", str(root), device="cpu")


def test_a_film_of_another_size_is_refused_before_it_is_decoded(videos):
    (path,) = videos.rglob("*.mp4")
    with av.open(str(path), "w") as film:
        stream = film.add_stream("libx264", rate=20)
        stream.width, stream.height = 1920, 1080
        for _ in range(11):
            film.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((1080, 1920, 3), np.uint8), "rgb24")))
        film.mux(stream.encode(None))
    said = rf"'{CAMERA}': .*file-000.mp4' have 1920 x 1080 pixels; .*\(16, 16, 3\)"
    with pytest.raises(ValueError, match=said):
        EpisodeStore.load("a/b", str(videos), device="cpu")
    verdicts = inspect(InspectConfig(InspectDatasetConfig("a/b", str(videos))))
    (verdict,) = [v for v in verdicts if v.check == "pictures"]
    assert verdict.level == "error"
    assert "1920 x 1080" in verdict.message


@pytest.mark.parametrize(
    "template",
    [
        "../other/{video_key}-{chunk_index}-{file_index}.mp4",
        "{root}/{video_key}.mp4",
        "videos/{video_key.__class__}/{file_index}.mp4",
        "videos/{video_key}/{chunk_index:999999999d}.mp4",
    ],
)
def test_a_template_that_leads_elsewhere_is_refused(videos, tmp_path, template):
    template = template.replace("{root}", str(tmp_path))
    for name in ("video_path", "data_path"):
        before = (videos / "meta" / "info.json").read_text()
        edit_info(videos, lambda info, name=name: info.update({name: template}))
        said = f"info.json: {name}|not in its folder"
        with pytest.raises(InspectionError, match=said):
            DatasetSource.open("a/b", videos)
        with pytest.raises(ValueError, match=said):
            EpisodeStore.load("a/b", str(videos), device="cpu")
        (videos / "meta" / "info.json").write_text(before)


def test_a_camera_whose_name_leads_elsewhere_is_refused(videos):
    rename_feature(videos, CAMERA, "../../secret")
    with pytest.raises(InspectionError, match="not in its folder"):
        DatasetSource.open("a/b", videos)


def test_an_episode_whose_file_number_is_a_path_is_refused(videos, tmp_path):
    edit_info(videos, lambda info: info.update(video_path="videos/{video_key}/{chunk_index}/{file_index}.mp4"))
    (path,) = videos.glob("meta/episodes/*/*.parquet")
    table = pq.read_table(path).replace_schema_metadata({})
    name = f"videos/{CAMERA}/file_index"
    table = table.set_column(table.column_names.index(name), name, pa.array(["../../../../secret"] * len(table)))
    pq.write_table(table, path)
    (videos / "videos" / CAMERA / "0").mkdir()
    (video,) = videos.rglob("*.mp4")
    video.rename(tmp_path / "secret.mp4")
    with pytest.raises(InspectionError, match=f"its pictures of '{CAMERA}' are lost"):
        looked(videos, tmp_path)


@pytest.mark.parametrize("what", ["statistics", "length", "more frames", "no number"])
def test_sound_is_attached_to_no_damaged_table(root, tmp_path, what):
    for episode in range(2):
        write_audio(tmp_path / f"{episode}.wav", np.zeros(16000, np.int16), 16000)
    if what == "more frames":
        edit_column(root, "episode_index", lambda _: 1)
    elif what == "no number":
        edit_column(root, "frame_index", lambda number: number or None)
    else:  # the last byte of a column's page, which has a checksum
        (path,) = root.glob("meta/episodes/*/*.parquet")
        pq.write_table(pq.read_table(path), path, write_page_checksum=True, use_dictionary=False)
        group = pq.read_metadata(path).row_group(0)
        chunks = {group.column(i).path_in_schema: group.column(i) for i in range(group.num_columns)}
        chunk = chunks["length" if what == "length" else "stats/action/mean.list.element"]
        data = bytearray(path.read_bytes())
        data[chunk.data_page_offset + chunk.total_compressed_size - 1] ^= 0xFF
        path.write_bytes(data)
    with pytest.raises(AttachError, match=r"file-000\.parquet.*playbyear-repair --root="):
        attach(root, tmp_path, str(tmp_path / "{episode}.wav"))
    assert not (tmp_path / "copy").exists()


def test_a_picture_that_is_missing_is_named(root):
    numbers = iter(range(11))
    edit_column(root, CAMERA, lambda picture: None if next(numbers) == 3 else picture)
    with pytest.raises(ValueError, match=f"'{CAMERA}': a picture is missing"):
        EpisodeStore.load("a/b", str(root))


@pytest.mark.parametrize("name", ["videos/more/x.mp4", "notes.txt", "meta/extra"])
def test_a_link_out_of_the_folder_is_never_uploaded_or_copied(root, secret, hub, tmp_path, name):
    link = root / name
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(secret if name != "meta/extra" else tmp_path)
    with pytest.raises(HubError, match=f"Not pushed.*{link}' is a link to"):
        push_dataset("me/hostile", root)
    assert not hub.requests
    with pytest.raises(AttachError, match="is a link to"):
        attach(root, tmp_path)


def test_links_in_a_circle_and_pipes_hold_no_upload_up(root):
    (root / "meta" / "loop").symlink_to("..")
    (root / "meta" / "self").symlink_to("self")
    os.mkfifo(root / "meta" / "pipe")
    check_links(root)
    names = _files(root)
    assert "meta/info.json" in names
    assert not [name for name in names if "loop" in name or "self" in name or "pipe" in name]


@pytest.mark.parametrize("part", ["data", "meta/episodes"])
def test_no_upload_and_no_copy_lacks_the_files_behind_a_link(root, hub, tmp_path, part):
    shutil.move(root / part, root / "kept")
    (root / part).symlink_to(root / "kept")
    with pytest.raises(HubError, match=f"Not pushed.*{part}' is a link to a folder"):
        push_dataset("me/linked", root)
    assert not hub.requests
    with pytest.raises(AttachError, match="is a link to a folder"):
        attach(root, tmp_path)


def test_a_folder_that_cannot_be_listed_is_an_error_of_the_upload(root, hub, monkeypatch):
    listed = Path.iterdir

    def fail(folder):
        if folder.name == "notes":
            raise PermissionError(errno.EACCES, "Permission denied", str(folder))
        return listed(folder)

    (root / "notes").mkdir()
    monkeypatch.setattr(Path, "iterdir", fail)
    with pytest.raises(HubError, match=r"Not pushed.*Permission denied"):
        push_dataset("me/noise", root)
    assert not hub.requests


@pytest.mark.parametrize("part", ["videos", "film", "data"])
def test_no_page_holds_what_a_link_leads_to(videos, tmp_path, part):
    place = next(videos.rglob("*.mp4")) if part == "film" else videos / part
    place.rename(tmp_path / "elsewhere")
    place.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InspectionError, match=r"No page is written.* is a link to .*elsewhere.*--dataset\.root"):
        looked(videos, tmp_path)
    assert not (tmp_path / "page.html").exists()
    verdicts = inspect(InspectConfig(InspectDatasetConfig("a/b", str(videos))))  # as one's own, on another disk
    assert {verdict.level for verdict in verdicts if verdict.check == "pictures"} == {"ok"}
    assert len(EpisodeStore.load("a/b", str(videos), device="cpu")) == 11


def test_links_that_stay_at_home_are_read_through(videos, tmp_path):
    """Those within the dataset, and those of the Hub's cache, whose files are links to its blobs."""
    (tmp_path / "link").symlink_to(videos)
    (videos / "videos").rename(videos / "kept")
    (videos / "videos").symlink_to("kept")
    findings, _ = looked(tmp_path / "link", tmp_path)
    assert {finding.level for finding in findings if finding.check == "pictures"} == {"ok"}
    (videos / "videos").unlink()
    (videos / "kept").rename(videos / "videos")
    cache = tmp_path / "hub" / "datasets--a--b"
    snapshot = cache / "snapshots" / "abc"
    (cache / "blobs").mkdir(parents=True)
    for number, path in enumerate([path for path in videos.rglob("*") if path.is_file()]):
        place = snapshot / path.relative_to(videos)
        place.parent.mkdir(parents=True, exist_ok=True)
        path.rename(cache / "blobs" / str(number))
        place.symlink_to(os.path.relpath(cache / "blobs" / str(number), place.parent))
    findings, _ = looked(snapshot, tmp_path)
    assert {finding.level for finding in findings if finding.check == "pictures"} == {"ok"}
    with pytest.raises(AttachError, match="Nothing was written"):  # only the sound is missing
        attach(snapshot, tmp_path)


class _Markup(html.parser.HTMLParser):
    """What a browser makes of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)


def test_the_page_shows_names_as_they_are(root, tmp_path):
    rename_task(root, EVIL + "</script><script>alert(1)</script><!-- episodes -->")
    page = tmp_path / "page.html"
    name = "a/{{script}}{{style}}{{policy}}<b>"
    inspect(InspectConfig(InspectDatasetConfig(name, str(root)), html=page))
    text = page.read_text()
    assert "<title>a/{{script}}{{style}}{{policy}}&lt;b&gt;</title>" in text
    assert text.count('"use strict"') == 1
    assert _Markup(text).tags.count("b") == 0
    assert (
        len([tag for tag in _Markup(text).tags if tag == "script"]) == 2 * 2 + 2
    )  # of each episode; of all, the page's
    data = json.loads(re.search(r'id="dataset">(.*?)</script>', text)[1])
    assert data["episodes"][0]["task"].startswith(EVIL)


def test_a_report_sends_no_commands_to_the_terminal(root, tmp_path, capsys):
    rename_feature(root, MICROPHONE, "observation.audio.\x1b]0;owned\x07\x1b[2J")
    inspect(InspectConfig(InspectDatasetConfig("a/b", str(root))))
    out = capsys.readouterr().out
    assert "\x1b" not in out
    assert "\x07" not in out
    assert "owned" in out


def assert_harmless(card: str, head: int = 1) -> None:
    """What Markdown's rules make of a card: no HTML, no link, no picture, no heading or block that a stranger made."""
    assert card.count("\n---\n") == head
    assert "# Head" not in [line.strip() for line in card.splitlines()]
    rest = re.sub(r"^```.*?^```$", "", card, flags=re.DOTALL | re.MULTILINE)  # blocks of code
    rest = re.sub(r"(`+)(?!`).*?(?<!`)\1(?!`)", "", rest)  # and code in a line
    assert not re.search(r"(?<!\\)<img src=x", rest)
    assert not re.search(r"(?<!\\)\]\(http://evil", rest)
    assert not re.search(r"(?<!\\)://evil", rest)
    assert not re.search(r"(?<!\\)!\[p", rest)


def test_the_card_of_a_dataset_shows_names_as_they_are(root):
    rename_task(root, EVIL)
    rename_feature(root, MICROPHONE, 'observation.audio.a`<img src=x>|"\n```\n# Head')
    edit_info(root, lambda info: info.update(robot_type=EVIL))
    card = describe_dataset(DatasetSource.open("a/b", root), "me/hostile", None, None)
    assert_harmless(card, head=0)
    rows = [line for line in card.splitlines() if line.startswith("| ")]
    assert all(len(re.findall(r"(?<!\\)\|", row)) == 3 for row in rows), rows
    code = re.search(r"^```python\n(.*?)^```$", card, re.DOTALL | re.MULTILINE)[1]
    names = [node.value for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Constant)]
    assert 'observation.audio.a`<img src=x>|"\n```\n# Head' in names


def test_a_card_shows_a_sample_rate_that_is_none(root):
    edit_info(root, lambda info: info["features"][MICROPHONE]["info"].update(sample_rate="<b>abc"))
    source = DatasetSource.open("a/b", root)
    card = describe_dataset(source, "a/b", None, None)
    assert "abc" in card
    assert "<b>" not in card


def test_the_card_of_a_policy_shows_names_as_they_are(root, hub):
    rename_task(root, EVIL)
    edit_info(root, lambda info: info.update(robot_type=EVIL))
    odd = "observation.images.a`|<img src=x>"
    policy = _policy(odd)
    meta = LeRobotDatasetMetadata("a/b", root=root)
    card = policy.generate_model_card("me/x\n---\n# Head", "playbyear", "mit", [], cfg=None, dataset_meta=meta)
    assert_harmless(str(card).split("---\n", 2)[2], head=str(_clean_card(policy)).count("\n---\n") - 1)
    assert "Lift" in card.text
    command = re.search(r"lerobot-rollout(.*?)```", card.text, re.DOTALL)[1]
    arguments = shlex.split(command.replace("\\\n", " "), comments=False)
    task = next(argument for argument in arguments if argument.startswith("--task="))
    assert "rm -rf" in task  # as a word of the task, and no command
    assert not {"$", "`", ";"} & set(task) - {";"}
    assert re.fullmatch(r"--robot\.type=[\w.-]+", next(a for a in arguments if a.startswith("--robot.type")))


def _policy(camera: str):
    from lerobot.configs import FeatureType, PolicyFeature

    from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
    from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy

    config = PlaybyearConfig(
        input_features={
            camera: PolicyFeature(FeatureType.VISUAL, (3, 16, 16)),
            MICROPHONE: PolicyFeature(FeatureType.STATE, (800,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (4,))},
        sample_rate=16000,
        image_size=16,
        vision_width=4,
        hidden_size=32,
        device="cpu",
        push_to_hub=False,
    )
    return PlaybyearPolicy(config)


def _clean_card(policy):
    meta = SimpleNamespace(
        repo_id="a/b",
        total_episodes=1,
        total_frames=1,
        fps=20,
        robot_type="x",
        camera_keys=[],
        tasks=pd.DataFrame(index=["Lift"]),
    )
    return policy.generate_model_card("me/x", "playbyear", "mit", [], cfg=None, dataset_meta=meta)


def _claims(kind: str, root: Path) -> None:
    """What the dataset in `root` claims; `cut` is a data file without its end, as a killed recording leaves it."""
    if kind == "cut":
        (path,) = root.glob("data/*/*.parquet")
        path.write_bytes(path.read_bytes()[:-300])

    def claim(info):
        if kind in ("sound", "cut"):
            feature = info["features"][MICROPHONE]
            feature["shape"] = [400_000_000]
            feature["info"]["sample_rate"] = 400_000_000 * info["fps"]
        elif kind == "state":
            info["features"]["observation.state"]["shape"] = [400_000_000]
        elif kind == "picture":
            info["features"][CAMERA]["shape"] = [100_000, 100_000, 3]
        elif kind == "fps":
            info["fps"] = 20_000_000
            info["features"][MICROPHONE]["info"]["sample_rate"] = 800 * 20_000_000
        elif kind == "episodes":
            info["total_episodes"] = 50_000_000

    edit_info(root, claim)


_OPEN = """
import resource, sys
from lerobot_playbyear.audio import write_audio
from lerobot_playbyear.training import EpisodeStore
from lerobot_playbyear.datasets.info import check_links
from lerobot_playbyear.datasets.survey import DatasetDamagedError, survey
from lerobot_playbyear.inspection.source import InspectionError
from lerobot_playbyear.inspection.inspect import InspectConfig, InspectDatasetConfig, inspect

def attempt(name, work):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        work()
        said = "nothing"
    except (ValueError, MemoryError, InspectionError, DatasetDamagedError) as error:
        said = " ".join(str(error).split())
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    print(f"{grown:.0f} MB|{name}|{said}", flush=True)

attempt("warm", lambda: EpisodeStore.load("a/b", sys.argv[1], device="cpu"))
attempt("warm", lambda: inspect(InspectConfig(InspectDatasetConfig("a/b", sys.argv[1]))))
for root in sys.argv[2:]:
    attempt(f"store {root}", lambda: EpisodeStore.load("a/b", root, device="cpu"))
    attempt(f"inspect {root}", lambda: inspect(InspectConfig(InspectDatasetConfig("a/b", root))))
    attempt(f"check {root}", lambda: survey(root))
"""


def test_claims_that_ask_for_gigabytes_get_none(made, tmp_path):
    kinds = ("sound", "cut", "state", "picture", "fps", "episodes")
    for kind in kinds:
        shutil.copytree(made, tmp_path / kind)
        _claims(kind, tmp_path / kind)
    result = subprocess.run(
        [sys.executable, "-c", _OPEN, str(made), *(str(tmp_path / kind) for kind in kinds)],
        capture_output=True,
        text=True,
        env={**os.environ, "HF_HUB_OFFLINE": "1"},
        check=False,
    )
    lines = [line for line in result.stdout.splitlines() if " MB|" in line]
    assert len(lines) == 2 + 3 * len(kinds), result.stdout[-3000:] + result.stderr[-3000:]
    for line in lines[2:]:
        grown, name, said = line.split("|", 2)
        assert float(grown.removesuffix(" MB")) < 150, line
        if name.startswith(("store", "inspect")) and "/picture" not in name:
            assert "info.json" in said or "playbyear-repair" in said, line


def test_a_rate_without_a_common_divisor_takes_no_gigabytes():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    rate = 44_101
    tone = (8000 * np.sin(2 * np.pi * 440 * np.arange(rate) / rate)).astype(np.int16)
    resampled, higher = at_a_rate_of_aac(np.stack([tone, -tone], axis=1), rate)
    samples = resampled[:]
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024 < 300
    assert higher == 48_000
    assert samples.shape == (pytest.approx(48_000, abs=50), 2)
    spectrum = np.abs(np.fft.rfft(samples[:, 0] * np.hanning(len(samples))))
    assert np.argmax(spectrum) * higher / len(samples) == pytest.approx(440, abs=2)
    assert np.abs(samples[1000:-1000, 0].astype(int) + samples[1000:-1000, 1]).max() <= 2
    assert np.abs(samples[1000:-1000]).max() == pytest.approx(8000, rel=0.02)
    pieces = np.concatenate([resampled[first : first + 7000] for first in range(0, 48_000, 7000)])
    assert np.abs(pieces[1000:-1000].astype(int) - samples[1000:-1000]).max() <= 2


def test_a_check_never_reads_what_a_picture_points_to(root, secret):
    point_to(root, str(secret))
    secret.unlink()
    os.mkfifo(secret)  # who reads it waits for ever
    survey(root)


def test_features_of_an_honest_dataset_are_believed(tmp_path):
    features = dataset_features(image_size=16)
    features["observation.grid"] = {"dtype": "float32", "shape": (4, 5), "names": None}
    features["observation.cube"] = {"dtype": "float32", "shape": (2, 3, 4), "names": None}
    make_dataset(tmp_path / "set", (3, 4), features=features)
    assert EpisodeStore.load("a/b", str(tmp_path / "set"), device="cpu").column("observation.cube").shape == (
        7,
        2,
        3,
        4,
    )
    assert len(DatasetSource.open("a/b", tmp_path / "set").episodes) == 2
