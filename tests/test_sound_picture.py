"""Pictures of sound: what they show, that nothing of the future is in them, and that rollouts show what datasets hold."""

import itertools
import json
from dataclasses import replace
from pathlib import Path

import draccus
import numpy as np
import pytest
import torch
import torchaudio
from dataset_factory import CAMERA, MICROPHONE, make_dataset
from draccus.utils import DecodingError
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.feature_utils import features_equal_for_merge
from lerobot.envs import make_env, preprocess_observation
from lerobot.envs.utils import NEW_ROLLOUT_OPTION, env_to_policy_features
from lerobot.policies.factory import get_policy_class
from lerobot.scripts import lerobot_edit_dataset, lerobot_eval, lerobot_train
from recording_factory import load
from support.recording import errors_in
from support.shared import run_in_process

from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.audio import attach_spectrogram as attaching
from lerobot_playbyear.audio.attach_spectrogram import AttachSpectrogramConfig, attach_spectrogram
from lerobot_playbyear.audio.sound_picture import HeardSound, SoundPicture, pictures_of, read_pictures
from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.reader import DatasetPlace
from lerobot_playbyear.datasets.survey import survey
from lerobot_playbyear.episodes import frames
from lerobot_playbyear.episodes.environment import RolloutError, env_facts, env_spec
from lerobot_playbyear.episodes.play import play
from lerobot_playbyear.episodes.pool import Script
from lerobot_playbyear.recording.record import RecordConfig, record

PICTURE = "observation.images.gripper"
HOW = SoundPicture(MICROPHONE, PICTURE, 16000, 20, 84, 84, 2, -80.0, -20.0, tuple(range(84)))
LENGTHS = (12, 25, 9)
SILENCE = {MICROPHONE: np.zeros(800, np.int16)}


def noise(n_frames: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, 2000, (n_frames, HOW.samples_per_frame)).astype(np.int16)


def watch(blocks: np.ndarray, how: SoundPicture = HOW) -> np.ndarray:
    """The pictures of an episode as a rollout makes them, (n, height, width, 3)."""
    heard = HeardSound(how)
    return np.stack([heard.add(block) for block in blocks])


def test_a_column_is_torchaudios_mel_spectrogram_of_the_newest_sound():
    sound = noise(2).reshape(-1)
    transform = torchaudio.transforms.MelSpectrogram(
        16000, n_fft=1024, win_length=800, hop_length=400, n_mels=84, center=False, power=2.0
    )
    wave = torch.from_numpy(sound / 32768.0).float()
    newest = torch.nn.functional.pad(wave[-800:], (112, 112))  # torch puts the window in the middle of the transform
    expected = 10 * torch.log10(transform(newest)[:, 0] * (2 / 400) ** 2 + 1e-10)
    levels = HOW.levels(sound[-HOW.context :])[-1]
    np.testing.assert_allclose(levels, expected.numpy(), atol=0.01)
    low = (20000 * np.sin(2 * np.pi * 500 / 16000 * np.arange(2 * HOW.samples_per_frame))).astype(np.int16)
    assert watch(low.reshape(2, -1))[-1][:, -1, 0].argmax() > 42, "low frequencies are at the bottom"


def test_sound_is_new_at_the_right_and_moves_left_without_changing():
    pictures = watch(noise(60))
    for before, after in itertools.pairwise(pictures):
        np.testing.assert_array_equal(after[:, :-2], before[:, 2:])
    silent = noise(60)
    silent[30:] = 0
    assert (watch(silent)[31, :, -1] == 0).all()
    assert (pictures == pictures[..., :1]).all(), "it is grey"


def test_nothing_of_the_future_is_in_a_picture():
    """Whoever changes all samples after a frame changes no pixel up to it; whoever changes one before, within reach, does."""
    sound = noise(60)
    pictures = watch(sound)
    for frame in (0, 1, 20, 58):
        changed = sound.copy()
        changed[frame + 1 :] = noise(60, seed=1)[frame + 1 :] * 10
        np.testing.assert_array_equal(watch(changed)[: frame + 1], pictures[: frame + 1])
        assert (watch(changed)[frame + 1] != pictures[frame + 1]).any()


@pytest.mark.parametrize(("fps", "rate", "columns"), [(5, 48000, 8), (30, 48000, 1)])
def test_other_rates_move_by_whole_columns_too(fps, rate, columns):
    how = replace(HOW, fps=fps, sample_rate=rate, columns_per_frame=columns)
    sound = np.random.default_rng(0).normal(0, 2000, (15, how.samples_per_frame)).astype(np.int16)
    pictures = watch(sound, how)
    np.testing.assert_array_equal(pictures[-1][:, :-columns], pictures[-2][:, columns:])


# Datasets


def config(root: Path, output: Path, **options) -> AttachSpectrogramConfig:
    places = DatasetPlace("t/heard", str(root)), DatasetPlace("t/seen", str(output))
    return AttachSpectrogramConfig(*places, **{"seconds": 0.5, **options})


def picture(dataset: LeRobotDataset, row: int, key: str = PICTURE) -> np.ndarray:
    """(height, width, 3) uint8, as stored."""
    return (dataset[row][key] * 255).round().byte().permute(1, 2, 0).numpy()


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("heard") / "dataset"
    make_dataset(root, LENGTHS, image_size=16, repo_id="t/heard", microphones=(MICROPHONE, "observation.audio.table"))
    return root


@pytest.fixture(scope="module")
def seen(original, tmp_path_factory) -> Path:
    return attach_spectrogram(config(original, tmp_path_factory.mktemp("seen") / "dataset"))


def test_every_frame_shows_the_last_seconds_and_all_else_stays(original, seen, tmp_path):
    before = {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in original.rglob("*") if path.is_file()}
    again = attach_spectrogram(config(original, tmp_path / "again"))
    assert {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in before} == before
    assert (again / "meta/info.json").read_bytes() == (seen / "meta/info.json").read_bytes()
    old, new = load(original), load(seen)
    assert set(new.features) - set(old.features) == {PICTURE, "observation.images.table"}
    (how, _) = read_pictures(seen)
    assert (how.height, how.width, how.columns_per_frame, how.seconds) == (16, 16, 1, 0.8), "the camera's size"
    row = 0
    for length in LENGTHS:
        blocks = np.stack([old[row + frame][MICROPHONE].numpy() for frame in range(length)]).astype(np.int16)
        for frame, expected in enumerate(watch(blocks, how)):
            np.testing.assert_array_equal(picture(new, row + frame), expected)
        assert torch.equal(new[row][CAMERA], old[row][CAMERA])
        row += length
    assert new.meta.stats[PICTURE]["mean"].shape == new.meta.stats[CAMERA]["mean"].shape
    pixels = np.stack([picture(new, row) for row in range(len(new))]) / 255
    np.testing.assert_allclose(new.meta.stats[PICTURE]["mean"].ravel(), pixels.mean((0, 1, 2)), atol=1e-6)
    assert survey(seen).is_undamaged
    assert not errors_in(seen)


def test_a_copy_that_fails_is_not_there(original, tmp_path, monkeypatch):
    monkeypatch.setattr(attaching, "encode_picture", lambda *_: (_ for _ in ()).throw(OSError("the disk is full")))
    with pytest.raises(OSError, match="disk is full"):
        attach_spectrogram(config(original, tmp_path / "new"))
    assert list(tmp_path.iterdir()) == []


def test_a_dataset_with_nothing_but_silence_is_refused(tmp_path):
    make_dataset(tmp_path / "silent", (3,), image_size=16, frame_of=lambda *frame: frame[-1] | SILENCE)
    with pytest.raises(InputError, match="nothing but silence"):
        attach_spectrogram(config(tmp_path / "silent", tmp_path / "seen"))


def test_lerobots_tools_keep_how_the_pictures_were_made_and_mix_no_levels(seen, tmp_path):
    less = ("--operation.type=delete_episodes", "--operation.episode_indices=[0]")
    places = ("--repo_id=t/seen", f"--root={seen}", "--new_repo_id=t/less", f"--new_root={tmp_path / 'less'}")
    run_in_process(lerobot_edit_dataset.main, *places, *less)
    assert read_pictures(tmp_path / "less") == read_pictures(seen)
    np.testing.assert_array_equal(picture(load(tmp_path / "less"), 0), picture(load(seen), LENGTHS[0]))
    features = load(seen).features
    other = {**features, PICTURE: {**features[PICTURE], "info": HOW.as_info()}}
    assert features_equal_for_merge(features, features)
    assert not features_equal_for_merge(features, other), "LeRobot would merge pictures of different levels"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"height": 10**9}, "height=1000000000; wanted at most 4096"),
        ({"sample_rate": 16001}, "sample_rate / fps"),
        ({"low_db": None}, "cannot be read"),
        ({"before_episode": [0]}, "84 numbers of 0 to 255"),
        ({"layout": 2}, "wanted 1, which this version makes"),
        ({"feature": "observation.state"}, "begins with observation.images."),
    ],
)
def test_a_dataset_that_says_nonsense_of_its_pictures_is_refused(change, message):
    info = {"spectrogram": {**HOW.as_info()["spectrogram"], **change}}
    with pytest.raises(InputError, match=message):
        pictures_of({PICTURE: {"info": info}})


# Environments


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """The first 46 frames of two attempts of the expert: a picture shows 42."""
    folder = tmp_path_factory.mktemp("recorded")
    env = env_spec(PlaybyearEnvConfig(task="OccludedGrasp-v1", episode_length=46)).make()
    features = frames.dataset_features(env_facts(env))
    with DurableWriter("t/heard", folder / "dataset", 20, features) as writer:
        for seed in (0, 1):
            for frame in frames.episode_frames(play(env, Script(), seed), features):
                writer.add_frame(frame)
            writer.save_episode()
    env.close()
    return attach_spectrogram(config(folder / "dataset", folder / "seen", seconds=2.0))


def env_config(recorded: Path, **options) -> PlaybyearEnvConfig:
    return PlaybyearEnvConfig(**{"task": "OccludedGrasp-v1", "spectrogram": str(recorded), **options})


@pytest.mark.slow
def test_a_rollout_shows_what_the_dataset_holds_bit_for_bit(recorded):
    """Two environments side by side play both episodes, one after the other and in the other order."""
    dataset = load(recorded)
    starts = [0, int(dataset.meta.episodes["length"][0])]
    cfg = env_config(recorded)
    vec = make_env(cfg, n_envs=2)["playbyear"][0]
    declared = {key: feature.shape for key, feature in env_to_policy_features(cfg).items() if key != "action"}
    for order in ([0, 1], [1, 0]):
        rows = [starts[episode] for episode in order]
        seeds = [int(dataset[row]["seed"]) for row in rows]
        observation, _ = vec.reset(seed=seeds, options={NEW_ROLLOUT_OPTION: True})
        for frame in range(46):
            batch = preprocess_observation(observation)
            assert {key: tuple(value.shape[1:]) for key, value in batch.items()} == declared
            items = [dataset[row + frame] for row in rows]
            for key in (MICROPHONE, PICTURE, CAMERA):
                assert torch.equal(batch[key], torch.stack([item[key].float() for item in items])), (key, frame)
            observation, *_ = vec.step(np.stack([item["action"].numpy() for item in items]))
    vec.close()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sound": "none"}, "--env.sound=none has no sound"),
        ({"microphones": ["table"]}, "the microphone 'gripper'; the environment has table"),
        ({"sample_rate": 48000}, "sample_rate=16000; the environment has 48000"),
        ({"task": "TellApart-v1"}, "sample_rate=16000|fps=20; the environment has"),
    ],
)
def test_an_environment_that_hears_otherwise_is_refused(recorded, options, message):
    with pytest.raises(DecodingError, match=message):
        env_config(recorded, **options)


def test_recording_with_pictures_of_sound_is_refused(recorded, tmp_path):
    arguments = ["--env.type=playbyear", f"--env.spectrogram={recorded}", "--env.task=OccludedGrasp-v1"]
    data = ["--dataset.repo_id=t/new", f"--dataset.root={tmp_path / 'new'}"]
    with pytest.raises(RolloutError, match="Leave it out here"):
        record(draccus.parse(RecordConfig, args=[*arguments, *data]))
    assert not (tmp_path / "new").exists()


# LeRobot's policies


def test_lerobots_policies_train_and_roll_out_and_hear(recorded, tmp_path, one_thread):
    policy = ("--policy.push_to_hub=false", "--policy.device=cpu", "--policy.pretrained_backbone_weights=null")
    sizes = "dim_model=32 n_heads=2 dim_feedforward=32 n_encoder_layers=1 n_vae_encoder_layers=1 latent_dim=4"
    small = (f"--policy.{size}" for size in sizes.split())
    chunk = ("--policy.chunk_size=5", "--policy.n_action_steps=1")
    data = ("--dataset.repo_id=t/seen", f"--dataset.root={recorded}", "--dataset.video_backend=pyav")
    run = ("--num_workers=0", "--batch_size=2", "--steps=2", f"--output_dir={tmp_path / 'train'}")
    run_in_process(lerobot_train.main, "--policy.type=act", *policy, *small, *chunk, *data, *run)
    checkpoint = tmp_path / "train/checkpoints/last/pretrained_model"
    env = ("--env.type=playbyear", "--env.task=OccludedGrasp-v1", "--env.episode_length=3")
    pictures = (f"--env.spectrogram={recorded}", "--env.visualization_width=64", "--env.visualization_height=64")
    two = (
        "--eval.n_episodes=2",
        "--eval.batch_size=2",
        "--eval.use_async_envs=false",
        f"--output_dir={tmp_path / 'eval'}",
    )
    run_in_process(lerobot_eval.main, f"--policy.path={checkpoint}", *env, *pictures, *two)
    assert json.loads((tmp_path / "eval/eval_info.json").read_text())["overall"]["n_episodes"] == 2
    policy = get_policy_class("act").from_pretrained(checkpoint).eval()
    item = load(recorded)[45]
    actions = []
    for shown in (item[PICTURE], 1 - item[PICTURE]):
        policy.reset()
        torch.manual_seed(0)
        batch = {key: value[None] for key, value in item.items() if key.startswith("observation.")}
        actions.append(policy.select_action({**batch, PICTURE: shown[None]}))
    assert not torch.equal(*actions), "what is heard has no part in what is done"
