"""What the pages show is there: films to listen to, small and in formats that browsers play."""

import re
from pathlib import Path

import av
import numpy as np
import pytest

DOCS = Path(__file__).parents[1] / "docs"
FOLDER = DOCS / "media" / "listen"
FILMS = sorted(path.name for path in FOLDER.glob("*.mp4"))


def test_page_guide_and_folder_name_the_same_films():
    assert len(FILMS) == 6
    assert sorted(re.findall(r"src='([^']+)'", (FOLDER / "index.html").read_text())) == FILMS
    assert sorted(set(re.findall(r"media/listen/(\w+\.mp4)", (DOCS / "listen.md").read_text()))) == FILMS


@pytest.mark.parametrize("name", FILMS)
def test_a_film_is_small_and_is_heard(name):
    path = FOLDER / name
    assert path.stat().st_size < 320_000
    with av.open(str(path)) as film:
        assert {stream.codec_context.name for stream in film.streams} == {"h264", "aac"}
        sound = np.concatenate([frame.to_ndarray().ravel() for frame in film.decode(audio=0)])
    assert np.abs(sound).max() > 0.4
