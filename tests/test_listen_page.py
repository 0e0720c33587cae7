"""The films to listen to are small, in formats that browsers play, and the same in page, guide and folder."""

import re
from pathlib import Path

import av
import numpy as np
import pytest

from experiments.listen_page import SCENES, page
from gym_playbyear import TASKS

DOCS = Path(__file__).parents[1] / "docs"
FOLDER = DOCS / "media" / "listen"
FILMS = {f"{scene.name}.mp4" for scene in SCENES}


def test_every_task_of_version_1_has_a_film():
    assert {scene.task for scene in SCENES} == {task for task in TASKS if task.endswith("-v1")}


def test_page_guide_and_folder_name_the_same_films():
    assert (FOLDER / "index.html").read_text() == page()
    assert set(re.findall(r"src='([^']+)'", page())) == FILMS
    assert set(re.findall(r"media/listen/(\w+\.mp4)", (DOCS / "listen.md").read_text())) == FILMS
    assert {path.name for path in FOLDER.glob("*.mp4")} == FILMS


@pytest.mark.parametrize("name", sorted(FILMS))
def test_a_film_is_small_and_is_heard(name):
    path = FOLDER / name
    assert path.stat().st_size < 320_000
    with av.open(str(path)) as film:
        assert {stream.codec_context.name for stream in film.streams} == {"h264", "aac"}
        sound = np.concatenate([frame.to_ndarray().ravel() for frame in film.decode(audio=0)])
    assert np.abs(sound).max() > 0.4
