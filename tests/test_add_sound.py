"""docs/tutorials/add_sound.md, as it stands there: a dataset of LeRobot's writer, and m4a files of a phone beside the robot.

What is heard and seen is made up: taps at known times, and a voice that begins a little after each episode's first frame.
"""

import re
import shutil
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from dataset_factory import CAMERA, dataset_features, make_dataset
from recording_factory import load
from support.pages import ROOT, run_page

from lerobot_playbyear.datasets import episode_waveform

pytestmark = pytest.mark.slow

PAGE = ROOT / "docs/tutorials/add_sound.md"
FPS, RATE = 30, 48000
N_FRAMES, TAPS_S = 135, (1.4, 2.71, 3.83)  # of each of three episodes
BEGIN_S = (7.31, 14.02, 21.87)  # when the episodes began, in the recording of the session
VOICE_S = 0.207  # the voice begins later than the episode
READ = (1.51, 2.26, 0.91)  # where a person found the voice in each episode's file [s]
KEY = "observation.audio.gripper"


def seen(episode: int, step: int, frame: dict[str, Any]) -> dict[str, Any]:
    """A bright hand that comes down and stops at a tap, then goes up again."""
    since = step / FPS - np.array(TAPS_S) - 0.07 * episode
    height = max(np.interp(since, [-0.4, 0, 0.35, 0.6], [0, 32, 32, 0]))
    picture = 50 + frame[CAMERA] // 16  # a camera's noise
    picture[round(height) : round(height) + 20, 20:44] = 230
    return {**frame, CAMERA: picture}


def heard() -> np.ndarray:
    """The session, (n,) int16."""
    rng = np.random.default_rng(0)
    sound = rng.normal(0, 15, 30 * RATE)
    tap = 9000 * np.sin(np.arange(1500) * 0.15) * np.exp(-np.arange(1500) / 300)
    voice = 2500 * np.sin(np.arange(RATE) * 0.02) * np.hanning(RATE)
    for episode, begin_s in enumerate(BEGIN_S):
        for at_s, one in [(VOICE_S, voice), *((tap_s + 0.07 * episode, tap) for tap_s in TAPS_S)]:
            first = round((begin_s + at_s) * RATE)
            sound[first : first + len(one)] += one
    return np.rint(sound).astype(np.int16)


def write_m4a(path: Path, samples: np.ndarray) -> None:
    with av.open(str(path), "w", format="ipod") as file:
        stream: Any = file.add_stream("aac", rate=RATE, layout="mono")
        for start in range(0, len(samples), 1024):
            block = np.ascontiguousarray(samples[None, start : start + 1024])
            frame = av.AudioFrame.from_ndarray(block, format="s16", layout="mono")
            frame.sample_rate, frame.pts, frame.time_base = RATE, start, Fraction(1, RATE)
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """What the page begins with."""
    here = tmp_path_factory.mktemp("silent")
    features = dataset_features(fps=FPS, image_size=64, use_videos=True, microphones=())
    features = {key: features[key] for key in (CAMERA, "observation.state", "action")}
    data = {"features": features, "fps": FPS, "repo_id": "me/demos", "frame_of": seen}
    make_dataset(here / "outputs/demos", (N_FRAMES,) * 3, **data)
    (here / "phone").mkdir()
    session = heard()
    write_m4a(here / "day.m4a", session)
    for episode, (begin_s, read_s) in enumerate(zip(BEGIN_S, READ, strict=True)):
        first = round((begin_s + VOICE_S - read_s) * RATE)
        write_m4a(here / f"phone/episode_{episode}.m4a", session[first : first + 8 * RATE])
    (here / "offsets.json").write_text(str(list(READ)))
    voices = [begin_s + VOICE_S for begin_s in BEGIN_S]
    (here / "labels.txt").write_text("".join(f"{at:.6f}\t{at:.6f}\tepisode\n" for at in voices))
    lines = [f"{episode},{1754400000 + begin_s / 1.001}\n" for episode, begin_s in enumerate(BEGIN_S)]
    (here / "times.csv").write_text("".join(lines))
    return here


@pytest.fixture(scope="module")
def said(folder, commands) -> list[str]:
    """What the page's commands printed, with which its folder is left."""
    small = {"--steps": 2, "--marks": "2.31=1754400002.3077, 27.3=1754400027.2727"}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        results = run_page(commands.succeed, PAGE, small, own={"rm": lambda _, path: shutil.rmtree(path)})
    return [result.output for result in results if result is not None]


def delay_ms(said: str) -> int:
    found = re.search(r"sound comes (\d+) ms (before|after) the picture of observation.images.front", said)
    assert found, said
    return int(found[1]) * (1 if found[2] == "after" else -1)


def test_sound_of_files_fits_the_pictures_after_the_pages_two_rounds(folder, said):
    first, second = (text for text in said if "sound and picture" in text)
    assert delay_ms(first) == pytest.approx(-1000 * VOICE_S, abs=8)
    assert delay_ms(second) == pytest.approx(0, abs=8)
    assert (folder / "outputs/demos.html").is_file()
    assert load(folder / "outputs/demos_with_sound").features[KEY]["info"]["sample_rate"] == 15990


def test_labels_and_a_clock_place_the_sound_of_a_session(folder, said):
    assert sum("the marks fit to" in text for text in said) == 1, "without marks nothing is said of them"
    by_label, by_clock = (load(folder / f"outputs/demos_{name}") for name in ("of_day", "by_clock"))
    for episode in range(3):
        for dataset, late_s in ((by_label, VOICE_S), (by_clock, 0)):
            waveform, rate = episode_waveform(dataset, episode, KEY)
            loud = np.flatnonzero(np.abs(waveform.astype(float)) > 3000) / rate - 1 / FPS
            assert loud[loud > 1][0] == pytest.approx(TAPS_S[0] + 0.07 * episode - late_s, abs=0.003)


def test_a_policy_trains_on_it(folder, said):
    assert (folder / "outputs/train/demos_with_sound/checkpoints/last/pretrained_model/model.safetensors").is_file()
