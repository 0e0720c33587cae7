"""The page of `playbyear-inspect --html` in a real browser: it plays, in time, and asks the network for nothing."""

import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Browser, find_chromium
from dataset_factory import dataset_features, make_dataset

from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.inspection import SurveyedDataset, check_numbers
from lerobot_playbyear.inspection.inspect import InspectConfig, InspectDatasetConfig, inspect
from lerobot_playbyear.inspection.page import PageWriter

pytestmark = pytest.mark.skipif(
    find_chromium() is None, reason="needs Chromium (Debian, Ubuntu: apt-get install chromium)"
)

FPS, SAMPLE_RATE, SIZE = 20, 16000, 64
BLOCK = SAMPLE_RATE // FPS
LENGTHS = (60, 40, 50)
CLICK = 31  # the frame at whose end a click is heard
TASK = "Touch </script><script>document.title = 'broken'</script> & <b>listen</b>"
READY = "document.querySelector('html[data-ready]') !== null"

# The film as a canvas sees it: how bright the picture shown is, 0 to 255.
BRIGHTNESS = """(() => {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 1;
  const context = canvas.getContext("2d");
  context.drawImage(document.getElementById("video"), 0, 0, 1, 1);
  return context.getImageData(0, 0, 1, 1).data[0];
})()"""

# When the film of the first episode is loudest, in seconds, as the browser's own decoder has it.
LOUDEST = """(async () => {
  const text = atob(document.getElementById("film-0").textContent);
  const bytes = Uint8Array.from(text, (letter) => letter.charCodeAt(0));
  const sound = await new OfflineAudioContext(1, 1, 48000).decodeAudioData(bytes.buffer);
  const samples = sound.getChannelData(0);
  let loudest = 0;
  for (let i = 0; i < samples.length; i++) if (Math.abs(samples[i]) > Math.abs(samples[loudest])) loudest = i;
  return [loudest / sound.sampleRate, Math.abs(samples[loudest])];
})()"""


def brightness(frame: int) -> int:
    return 30 + 3 * frame


def write_marked_dataset(root: Path) -> Path:
    """Every picture's brightness tells its frame; one click; the expert acts now and then; one failure."""
    features = dataset_features(FPS, SAMPLE_RATE, SIZE, state_size=2, action_size=9)
    features["observation.state"]["names"] = ["height", "speed"]
    features["next.success"] = {"dtype": "bool", "shape": (1,), "names": None}
    del features["next.reward"]
    rng = np.random.default_rng(0)
    with DurableWriter("tests/page", root, FPS, features) as writer:
        for episode, length in enumerate(LENGTHS):
            for t in range(length):
                sound = rng.normal(0, 10, BLOCK)
                sound[-10:] += 20000 * (t == CLICK)
                frame = {
                    "observation.images.front": np.full((SIZE, SIZE, 3), brightness(t), np.uint8),
                    "observation.audio.gripper": sound.astype(np.int16),
                    "observation.state": np.array([0.01 * t, 5.0], np.float32),
                    "action": np.sin(np.arange(9) + t / 5).astype(np.float32),
                    "intervention": np.array([10 <= t < 20]),
                    "next.success": np.array([t == length - 1 and episode != 1]),
                }
                writer.add_frame({**frame, "task": TASK})
            writer.save_episode()
    return root


@pytest.fixture(scope="module")
def browser(tmp_path_factory) -> Iterator[Browser]:
    browser = Browser(tmp_path_factory.mktemp("browser"))
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("marked")
    return page_of(write_marked_dataset(folder / "dataset"), "tests/page")


def page_of(root: Path, repo_id: str = "tests/noise", **options: Any) -> Path:
    """Beside a dataset."""
    page = root.with_name("page.html")
    inspect(InspectConfig(InspectDatasetConfig(repo_id, str(root)), html=page, **options))
    return page


@pytest.fixture
def page(browser, written) -> Browser:
    return show(browser, written)


def show(browser: Browser, path: Path, place: str = "") -> Browser:
    browser.open("about:blank")
    browser.open(path.as_uri() + place)
    browser.wait(READY)
    assert browser.messages == []
    return browser


def text(page: Browser, selector: str) -> str:
    return page.evaluate(f"document.querySelector({selector!r}).innerText")


def frame(page: Browser) -> int:
    return int(text(page, "#time").split("frame ")[1].split(" of ")[0])


def cursor(page: Browser) -> float:
    """Where the cursor stands [pixels]."""
    return page.evaluate("document.getElementById('cursor').getBoundingClientRect().left")


def test_space_plays_picture_and_sound_and_moves_the_cursor(page):
    start = cursor(page)
    page.press(" ")
    page.wait("document.getElementById('video').currentTime > 0.5")
    assert page.evaluate("document.getElementById('video').webkitAudioDecodedByteCount") > 0
    assert page.evaluate("document.getElementById('video').muted") is False
    first, first_brightness = cursor(page), page.evaluate(BRIGHTNESS)
    time.sleep(0.3)
    assert cursor(page) > first > start
    assert page.evaluate(BRIGHTNESS) > first_brightness
    page.press(" ")
    page.wait("document.getElementById('video').paused")
    stopped = frame(page)
    time.sleep(0.2)
    assert frame(page) == stopped > 10


def test_the_arrows_step_through_the_very_frames(page):
    keys = ["ArrowRight"] * 3 + ["ArrowLeft"]
    for key, expected in zip(keys, (1, 2, 3, 2), strict=True):
        page.press(key)
        assert frame(page) == expected
    page.press("ArrowRight", shift=True)
    for at, key in ((12, None), (LENGTHS[0] - 1, "End"), (LENGTHS[0] - 2, "ArrowLeft"), (0, "Home")):
        if key:
            page.press(key)
        assert frame(page) == at
        page.wait("!document.getElementById('video').seeking")
        page.wait(f"Math.abs({BRIGHTNESS} - {brightness(at)}) <= 1")  # one frame is 3 apart


def test_up_and_down_change_the_episode(page):
    page.press("ArrowDown")
    page.wait("document.documentElement.dataset.episode == '1'")
    assert text(page, "#episode-title") == "Episode 1"
    assert text(page, "#time").endswith(f"of {LENGTHS[1] - 1}")
    for key in ("ArrowDown", "ArrowDown", "ArrowDown"):  # faster than films load; beyond the last nothing happens
        page.press(key)
    page.wait("document.documentElement.dataset.episode == '2'")
    page.press("ArrowUp")
    page.press("ArrowUp")
    page.wait("document.documentElement.dataset.episode == '0'")
    assert page.evaluate("document.querySelector('#episodes [aria-selected=true] b').innerText") == "0"


def test_o_goes_to_the_sudden_sound_that_was_recorded(page):
    page.press("o")
    assert frame(page) == CLICK - 1  # it is heard between this picture and the next


def click_in_timeline(page: Browser, panel: int) -> None:
    """In its middle."""
    place = page.evaluate(f"document.querySelectorAll('.panel > canvas')[{panel}].getBoundingClientRect().toJSON()")
    page.click(place["left"] + place["width"] / 2, place["top"] + 20)


def test_a_click_in_the_timeline_seeks_and_goes_on_playing_what_was_started_anew(page):
    click_in_timeline(page, 3)
    assert frame(page) == pytest.approx(LENGTHS[0] / 2, abs=3)
    page.press("End")
    page.press(" ")
    page.wait("!document.getElementById('video').paused && document.getElementById('video').currentTime < 1")
    click_in_timeline(page, 0)
    page.wait("!document.getElementById('video').paused && document.getElementById('video').currentTime > 1")


def test_other_keys_do_what_the_help_says(page):
    page.press("?")
    page.wait("document.getElementById('keys').open")
    page.press(" ")
    assert page.evaluate("document.getElementById('video').paused")
    page.evaluate("document.getElementById('keys').close()")
    theme = page.evaluate("document.documentElement.dataset.theme")
    page.press("t")
    assert page.evaluate("document.documentElement.dataset.theme") != theme
    page.press("m")
    assert page.evaluate("document.getElementById('video').muted")
    page.press(".")
    assert page.evaluate("document.getElementById('video').playbackRate") == 2
    page.press("c")
    assert page.evaluate("document.getElementById('checks').hidden")
    page.press("s")
    assert "own scales" in text(page, "#panels")


def test_the_sound_is_in_time_with_the_pictures(page):
    """The click at the end of block 31 was heard as picture 31 was taken."""
    loudest, level = page.evaluate(LOUDEST)
    assert loudest == pytest.approx(CLICK / FPS, abs=0.01)
    assert level > 0.3


def test_what_is_shown_is_what_was_recorded_and_an_address_names_episode_and_frame(browser, written):
    page = show(browser, written, "#episode=2&frame=7")
    assert text(page, "#episode-title") == "Episode 2"
    assert frame(page) == 7
    assert text(page, "#task") == TASK  # and is no markup
    assert page.evaluate("document.title") == "tests/page"
    assert "20 %, 1 span" in text(page, "#episode-facts")
    assert text(page, "#episodes").count("✓") == 2
    assert text(page, "#episodes").count("✕") == 1
    page.press("End")
    assert f"{0.01 * (LENGTHS[2] - 1):.3g}" in text(page, "#panels")  # the state's value at the cursor
    assert "height" in text(page, "#panels")


def test_no_request_leaves_the_page_and_none_could(page, written):
    """Its policy forbids it: a server that is there hears nothing."""
    for key in (" ", "ArrowDown", "t", "ArrowUp", "End"):
        page.press(key)
        time.sleep(0.1)
    assert {address.split(":")[0] for address in page.requests} <= {"file", "data", "blob", "about"}
    assert [address for address in page.requests if address.startswith("file")] == [written.as_uri()]
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(5)
        address = f"http://127.0.0.1:{server.getsockname()[1]}"
        image = f"Object.assign(new Image(), {{onload: done, onerror: fail, src: '{address}/image'}})"
        for attempt in (
            f"fetch('{address}/fetch', {{mode: 'no-cors'}})",
            f"new Promise((done, fail) => {image})",
            f"import('{address}/module')",
        ):
            assert page.evaluate(f"{attempt}.then(() => 'allowed', () => 'refused')") == "refused"
        page.call(
            "Runtime.evaluate", expression=f"location = '{address}/open'"
        )  # a navigation is heard, and it is the first
        assert server.accept()[0].recv(99).startswith(b"GET /open")


def test_a_video_dataset_of_two_cameras_and_two_microphones_at_an_odd_rate(browser, tmp_path):
    cameras = ("observation.images.front", "observation.images.wrist")
    microphones = ("observation.audio.left", "observation.audio.right")
    options: dict[str, Any] = {"use_videos": True, "cameras": cameras, "microphones": microphones}
    make_dataset(tmp_path / "dataset", (30,), fps=30, sample_rate=19200, image_size=64, **options)
    page = show(browser, page_of(tmp_path / "dataset", picture_height=48))
    size = page.evaluate("[document.getElementById('video').videoWidth, document.getElementById('video').videoHeight]")
    assert size == [96, 48]
    assert text(page, "#cameras").split() == ["front", "wrist"]
    assert "L left, R right" in text(page, "#heard")

    assert page.evaluate("document.getElementById('video').duration") == pytest.approx(1, abs=0.1)


def test_a_dataset_without_sound_and_cameras_is_shown_by_its_curves(browser, tmp_path):
    features = {key: {"dtype": "float32", "shape": (3,), "names": None} for key in ("observation.state", "action")}
    make_dataset(tmp_path / "dataset", (30,), features=features)
    page = show(browser, page_of(tmp_path / "dataset"))
    assert page.evaluate("document.getElementById('screen').hidden")
    assert "no sound" in text(page, "header")
    assert page.evaluate("document.querySelectorAll('.panel').length") == 4
    page.press(" ")
    page.wait("document.getElementById('video').currentTime > 0.3")


@pytest.mark.slow
def test_a_page_of_fifty_episodes_opens_in_two_seconds_and_is_small(browser, recorded, tmp_path):
    """Of the expert's episodes, with contact sound."""
    dataset = SurveyedDataset.open("tests/demos", recorded)
    path = tmp_path / "page.html"
    with PageWriter(path, dataset) as writer:
        for i in range(50):
            episode = dataset.episodes[i % 2]
            writer.add(episode, {camera: dataset.pictures(camera, episode) for camera in dataset.cameras})
        writer.finish(check_numbers(dataset))
    assert path.stat().st_size < 30e6
    browser.open("about:blank")
    start = time.monotonic()
    show(browser, path)
    assert time.monotonic() - start < 2
    assert browser.evaluate("document.getElementById('episodes').children.length") == 50
