"""Sound attached to datasets that were recorded without it."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from dataset_factory import CAMERA, dataset_features, make_dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_playbyear.audio import write_audio
from lerobot_playbyear.audio.attach_audio import AttachAudioConfig, AttachError, DatasetPlace, attach_audio
from lerobot_playbyear.datasets import episode_waveform
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.survey import survey

FPS, RATE = 20, 16000
SIZE = RATE // FPS
LENGTHS = (12, 17, 9)
KEY = "observation.audio.gripper"
OFFSET = 0.25


def silent_dataset(root: Path, **options) -> LeRobotDataset:
    features = {
        k: f for k, f in dataset_features(image_size=16, **options).items() if not k.startswith("observation.audio")
    }
    return make_dataset(root, LENGTHS, features=features, repo_id="test/silent")


def noise(episode: int, n_samples: int, n_channels: int = 1) -> np.ndarray:
    return np.random.default_rng(episode).integers(-3000, 3000, (n_samples, n_channels)).astype(np.int16)


def write_sounds(folder: Path, rate: int = RATE, ending: str = "wav", n_channels: int = 1) -> str:
    for episode, length in enumerate(LENGTHS):
        n_samples = round((OFFSET + length / FPS) * rate)
        write_audio(folder / f"{episode:03d}.{ending}", noise(episode, n_samples, n_channels), rate)
    return f"{folder}/{{episode:03d}}.{ending}"


@pytest.fixture(scope="module")
def silent(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("silent") / "dataset"
    silent_dataset(root)
    return root


def config(dataset: Path, output: Path, files: str, **options) -> AttachAudioConfig:
    places = DatasetPlace("test/silent", str(dataset)), DatasetPlace("test/heard", str(output))
    return AttachAudioConfig(*places, files, **{"microphone": "gripper", "offset": OFFSET, **options})


def load(root: Path) -> LeRobotDataset:
    return LeRobotDataset("test/heard", root=root, video_backend="pyav")


@pytest.mark.parametrize("ending", ["wav", "flac"])
def test_every_frame_gets_what_was_heard_before_it(silent, tmp_path, ending):
    root = attach_audio(config(silent, tmp_path / "heard", write_sounds(tmp_path / "sound", ending=ending)))

    dataset = load(root)
    first = round(OFFSET * RATE) - SIZE
    for episode, length in enumerate(LENGTHS):
        waveform, rate = episode_waveform(dataset, episode, KEY)
        assert rate == RATE
        sound = noise(episode, round((OFFSET + length / FPS) * RATE))[:, 0]
        np.testing.assert_array_equal(waveform, sound[first : first + length * SIZE])
    item = dataset[12]
    assert item[KEY].shape == (SIZE,)
    assert survey(root).is_sound
    assert {path.name for path in tmp_path.iterdir()} == {"heard", "sound"}


def test_all_else_stays_as_it_was(silent, tmp_path):
    before = {path: path.stat().st_mtime_ns for path in silent.rglob("*")}
    root = attach_audio(config(silent, tmp_path / "heard", write_sounds(tmp_path / "sound")))
    old, new = LeRobotDataset("test/silent", root=silent, video_backend="pyav"), load(root)
    assert set(new.meta.features) - set(old.meta.features) == {KEY}
    for i in (0, 13, 37):
        for key, value in old[i].items():
            assert np.array_equal(np.asarray(new[i][key]), np.asarray(value)), key
    assert new.meta.stats.keys() == {*old.meta.stats, KEY}
    samples = np.concatenate([episode_waveform(new, episode, KEY)[0] for episode in range(3)])
    np.testing.assert_allclose(new.meta.stats[KEY]["std"], samples.std(), rtol=1e-3)
    np.testing.assert_array_equal(new.meta.stats["action"]["mean"], old.meta.stats["action"]["mean"])
    assert {path: path.stat().st_mtime_ns for path in silent.rglob("*")} == before


def test_video_is_copied_and_two_channels_become_two_microphones(tmp_path):
    silent_dataset(tmp_path / "film", use_videos=True)
    files = write_sounds(tmp_path / "sound", n_channels=2)
    root = attach_audio(config(tmp_path / "film", tmp_path / "heard", files, microphone="left, right"))
    dataset = load(root)
    assert dataset[20][CAMERA].shape == (3, 16, 16)
    expected = noise(1, round((OFFSET + LENGTHS[1] / FPS) * RATE), 2)
    for channel, key in enumerate(("observation.audio.left", "observation.audio.right")):
        waveform, _ = episode_waveform(dataset, 1, key)
        np.testing.assert_array_equal(waveform[:100], expected[round(OFFSET * RATE) - SIZE :, channel][:100])
    assert survey(root).is_sound


def test_sound_of_another_rate_is_resampled(silent, tmp_path):
    files = write_sounds(tmp_path / "sound", rate=11025)
    with pytest.raises(AttachError, match=r"11025 samples per second.*no multiple of 20.*--sample_rate=11020"):
        attach_audio(config(silent, tmp_path / "heard", files))
    root = attach_audio(config(silent, tmp_path / "heard", files, sample_rate=48000))
    assert load(root).features[KEY]["info"]["sample_rate"] == 48000
    assert load(root)[3][KEY].shape == (2400,)


def test_each_episode_may_have_its_own_offset(silent, tmp_path):
    files = write_sounds(tmp_path / "sound")
    (tmp_path / "offsets.json").write_text("[0, 0.05, -0.1]")
    cfg = config(silent, tmp_path / "heard", files, offset=0.1, offsets=tmp_path / "offsets.json", pad=True)
    dataset = load(attach_audio(cfg))
    for episode, offset in enumerate((0.1, 0.15, 0.0)):
        waveform, _ = episode_waveform(dataset, episode, KEY)
        sound = noise(episode, round((OFFSET + LENGTHS[episode] / FPS) * RATE))[:, 0]
        np.testing.assert_array_equal(waveform[2 * SIZE : 3 * SIZE], sound[round(offset * RATE) + SIZE :][:SIZE])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"files": "nowhere/{episode}.wav"}, r"episode 0, nowhere/0\.wav: There is no sound file(.|\n)*episode 2,"),
        ({"files": "sound.wav"}, r"say with \{episode\}"),
        ({"files": "{episode}/{camera}.wav"}, "Only {episode} may stand in it"),
        ({"offset": 3.0}, r"episode 0, .*000\.wav: it lasts 0\.850 s; 12 frames.*more\. Correct the offset"),
        ({"microphone": "left,right"}, "1 channels, and --microphone names 2"),
        ({"microphone": ""}, "a name of its own"),
        ({"channel": 4}, "there is no --channel=4"),
        ({"offsets": Path("missing.json")}, "is no list of numbers"),
        ({"dataset": DatasetPlace("test/nothing", "/nonexistent/dataset")}, "There is no dataset in /nonexistent"),
    ],
)
def test_what_does_not_fit_is_one_clear_error(silent, tmp_path, options, message):
    files = write_sounds(tmp_path / "sound")
    cfg = config(silent, tmp_path / "heard", files)
    for key, value in options.items():
        setattr(cfg, key, value)
    with pytest.raises(AttachError, match=message):
        attach_audio(cfg)
    assert [path.name for path in tmp_path.iterdir()] == ["sound"]


def test_a_copy_that_cannot_be_made_is_told_before_any_sound_is_read(silent, tmp_path):
    (tmp_path / "file").touch()
    nothing_there = config(silent, tmp_path / "file/heard", str(tmp_path / "{episode}.wav"))
    with pytest.raises(
        InputError, match=r"--output.root=.*/heard cannot be written: Not a directory in .*/file; wanted"
    ):
        attach_audio(nothing_there)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_second_microphone_and_never_the_same_twice(silent, tmp_path):
    files = write_sounds(tmp_path / "sound")
    one = attach_audio(config(silent, tmp_path / "one", files))
    with pytest.raises(AttachError, match="is there already"):
        attach_audio(config(silent, one, files))
    with pytest.raises(AttachError, match=f"'{KEY}' is in the dataset already"):
        attach_audio(config(one, tmp_path / "two", files))
    two = attach_audio(config(one, tmp_path / "two", files, microphone="table"))
    assert {KEY, "observation.audio.table"} <= set(load(two).features)


@pytest.mark.slow
def test_lerobot_trains_on_it(silent, tmp_path):
    """The command as it is typed, and then LeRobot's own training."""
    files = write_sounds(tmp_path / "sound")
    places = [f"--dataset.repo_id=test/silent --dataset.root={silent}", "--output.repo_id=test/heard"]
    attach = [
        "from lerobot_playbyear.scripts.commands import attach_audio; attach_audio()",
        *" ".join(places).split(),
        f"--output.root={tmp_path / 'heard'}",
    ]
    run(*attach, f"--files={files}", "--microphone=gripper", f"--offset={OFFSET}")
    run(
        "from lerobot.scripts.lerobot_train import main; main()",
        ["--policy.type=playbyear", "--policy.device=cpu", "--policy.push_to_hub=false", "--policy.image_size=32"],
        ["--policy.vision_width=4", "--dataset.repo_id=test/heard", "--batch_size=2", "--steps=2", "--num_workers=0"],
        f"--dataset.root={tmp_path / 'heard'}",
        f"--output_dir={tmp_path / 'train'}",
    )
    config = json.loads((tmp_path / "train/checkpoints/last/pretrained_model/config.json").read_text())
    assert KEY in config["input_features"]


def run(program: str, *arguments: str | list[str]) -> None:
    flat = [part for argument in arguments for part in ([argument] if isinstance(argument, str) else argument)]
    result = subprocess.run([sys.executable, "-c", program, *flat], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-3000:]
