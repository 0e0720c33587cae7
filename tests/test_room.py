"""Recorded noise and other microphones in the environment: they change the sound, without seams, and nothing else."""

import hashlib
import itertools
import json
import runpy
import shutil
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from lerobot.envs.configs import EnvConfig  # noqa: F401  (registers LeRobot's own environments first)
from scipy import signal
from scipy.io import wavfile

from gym_playbyear.registry import OptionError
from gym_playbyear.room import Room
from gym_playbyear.sound import BACKGROUND_RMS
from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.policy.sound_augmentation import RecordedNoise

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))

import room_recordings

TASK = "gym_playbyear:gym_playbyear/OccludedGrasp-v1"
N_STEPS = 12


@pytest.fixture
def chirp(tmp_path):
    """Half a second of a rising tone in two channels, at another sample rate than the task's."""
    time = np.arange(22050) / 44100
    wave = 0.3 * signal.chirp(time, 300, 0.5, 3000)
    wavfile.write(tmp_path / "chirp.wav", 44100, (32767 * np.stack([wave, wave], axis=1)).astype(np.int16))
    return str(tmp_path / "chirp.wav")


def heard(room, microphone="gripper", seed=3, **options):
    """Everything but sound, and the sound (n,) in [-1, 1], of some random steps."""
    env = gym.make(TASK, image_size=16, room=room, **options)
    observation, _ = env.reset(seed=seed)
    others, sound = [], [observation.pop(f"audio.{microphone}")]
    others.append(observation)
    rng = np.random.default_rng(0)
    for _ in range(N_STEPS):
        observation, *_ = env.step(rng.uniform(-0.3, 0.3, 4).astype(np.float32))
        sound.append(observation.pop(f"audio.{microphone}"))
        others.append(observation)
    env.close()
    return others, np.concatenate(sound) / 32767


@pytest.fixture
def hiss(tmp_path):
    """Half a second of noise without a tone that a room could weaken."""
    wave = np.random.default_rng(0).uniform(-0.3, 0.3, 8000)
    wavfile.write(tmp_path / "hiss.wav", 16000, (32767 * wave).astype(np.int16))
    return str(tmp_path / "hiss.wav")


def test_a_recording_is_added_at_its_level_and_goes_on_from_step_to_step(chirp, hiss):
    quiet, plain = heard(None, microphones=("gripper",))
    noisy, sound = heard({"noise": chirp, "noise_level": 8.0}, microphones=("gripper",))
    for ours, theirs in zip(quiet, noisy, strict=True):
        assert np.array_equal(ours["agent_pos"], theirs["agent_pos"])
        assert np.array_equal(ours["pixels"]["front"], theirs["pixels"]["front"])
    added = sound - plain
    assert len(added) == (N_STEPS + 1) * 800
    np.testing.assert_allclose(added[8000:], added[: len(added) - 8000], atol=1.1 / 32767)  # once around, and again
    assert np.abs(np.diff(added)).max() < 0.02 * 8  # no clicks between steps
    _, silent = heard(None, microphones=("gripper",), noise_level=0.0)
    background = (plain - silent)[: 4 * 800]  # the unit of the level
    assert 0.5 * BACKGROUND_RMS < np.sqrt(np.mean(background**2)) < 2 * BACKGROUND_RMS
    _, sound = heard({"noise": hiss, "noise_level": 8.0}, microphones=("gripper",))
    assert -3.5 < level((sound - plain)[:8000]) - 20 * np.log10(8 * BACKGROUND_RMS) < 3.5  # dB


@pytest.mark.parametrize("response", ["phone", "dull", "boomy"])
def test_a_microphone_filters_all_that_it_hears_without_seams(response):
    _, plain = heard(None, microphones=("gripper",))
    _, sound = heard({"response": response}, microphones=("gripper",))
    kind, corner, added = {
        "phone": ("bandpass", (300, 3400), 0),
        "dull": ("lowpass", 900, 0),
        "boomy": ("lowpass", 300, 3),
    }[response]
    passed = signal.sosfilt(signal.butter(1, corner, kind, fs=16000, output="sos"), plain)
    np.testing.assert_allclose(sound, np.clip(plain + added * passed if added else passed, -1, 1), atol=1 / 32767)


EARS = ("gripper", "room")


def level(wave):
    """[dBFS]"""
    return 20 * np.log10(max(np.std(wave), 1e-6))


def first_sounds(microphones, seed, **options):
    """Of an episode's first two seconds, in which the arm rests: by microphone (n,) in [-1, 1]."""
    env = gym.make(TASK, image_size=16, microphones=microphones, **options).unwrapped
    observation, _ = env.reset(seed=seed)
    sounds = [observation] + [env.step(np.zeros(4, np.float32))[0] for _ in range(39)]
    env.close()
    return {name: np.concatenate([each[f"audio.{name}"] for each in sounds]) / 32767 for name in microphones}


def likeness(first, second):
    """Their largest correlation within 200 samples."""
    spectra = np.fft.rfft([first - first.mean(), second - second.mean()], 2 * len(first))
    across = np.fft.irfft(spectra[1] * spectra[0].conj())
    return np.abs(np.concatenate([across[-200:], across[:201]])).max() / (
        np.linalg.norm(first) * np.linalg.norm(second)
    )


def test_one_recording_reaches_all_microphones_each_in_its_own_way_and_their_own_noise_does_not(chirp):
    room = {"noise": chirp, "noise_level": 30.0}
    loud = [first_sounds(EARS, seed, room=room, noise_level=0.0) for seed in range(6)]
    assert np.median([likeness(*each.values()) for each in loud]) > 0.5
    levels = np.array([[level(wave) for wave in each.values()] for each in loud])
    assert 0.3 < np.abs(np.diff(levels)).mean() < 6  # dB
    assert len({each["room"][:100].tobytes() for each in loud}) == len(loud)  # somewhere else in each episode
    alone = [first_sounds(EARS, seed) for seed in range(3)]
    hums = signal.butter(4, 400, "highpass", fs=16000, output="sos")  # the arm's is one, and both hear it
    apart = [likeness(*(signal.sosfilt(hums, wave) for wave in each.values())) for each in alone]
    assert max(apart) < 0.1


def test_the_same_seed_is_the_same_noise_and_a_second_microphone_does_not_change_the_first(chirp):
    room = {"noise": chirp, "noise_level": 8.0, "response": "dull"}
    both, again = (first_sounds(EARS, 3, room=room) for _ in range(2))
    assert all(np.array_equal(both[name], again[name]) for name in EARS)
    assert np.array_equal(first_sounds(EARS[:1], 3, room=room)["gripper"], both["gripper"])
    assert not np.array_equal(first_sounds(EARS, 4, room=room)["gripper"], both["gripper"])


def test_a_touch_is_much_louder_at_the_gripper_than_in_the_room():
    """By 15 dB and more; the background is as loud at both, but for the draws of an episode."""
    louder, background = [], []
    for seed in range(6):
        env = gym.make(TASK, image_size=16, microphones=EARS).unwrapped
        env.reset_physics(seed=seed)
        expert, done, levels, touch = env.scripted_expert(), False, [], None
        while not done:
            _, terminated, truncated, _ = env.step_physics(expert.act())
            done = terminated or truncated
            if touch is None and env.contact_forces["gripper-cube"] > 0.2:
                touch = len(levels)
            levels.append([level(env.listen()[name] / 32767) for name in EARS])
        env.close()
        louder.append(levels[touch][0] - levels[touch][1])
        background.append(np.diff(np.quantile(levels, 0.1, axis=0))[0])
    assert min(louder) > 15
    assert np.median(louder) > 22
    assert np.abs(background).max() < 9


def test_what_cannot_be_is_refused_with_option_and_value(tmp_path):
    wavfile.write(tmp_path / "silent.wav", 16000, np.zeros(1000, np.int16))
    with pytest.raises(OptionError, match="it is silent"):
        Room(("gripper",), 16000, str(tmp_path / "silent.wav"))
    whole = (tmp_path / "silent.wav").read_bytes()
    for content in (
        b"no sound",
        b"",
        b"fLaC\0\0\0\x22",
        whole[:20],
        whole[:24] + bytes(4) + whole[28:],  # of rate 0
        whole[:24] + b"\xff" * 4 + whole[28:],
        whole[:22] + bytes(2) + whole[24:],  # of no channel
        whole[:32] + bytes(4) + whole[36:],  # of samples of no bits
        whole[:36],
    ):
        path = tmp_path / f"{len(content)}.wav"
        path.write_bytes(content)
        with pytest.raises(OptionError, match="cannot be read as a WAV file"):
            Room(("gripper",), 16000, str(path))


# Recordings to test with


def test_the_held_out_recordings_share_nothing_with_those_that_choices_are_made_on():
    sets = json.loads(room_recordings.LIST.read_text())["recordings"]
    assert set(sets) == set(room_recordings.SETS)
    packages, hashes = [], []
    for kinds in sets.values():
        assert set(kinds) == set(room_recordings.KINDS)
        sources = [source for found in kinds.values() for source in found]
        assert all(source["licence"] and source["version"] and source["files"] for source in sources)
        packages.append({source["package"] for source in sources})
        hashes.append({each for source in sources for each in source["files"].values()})
    assert packages[0].isdisjoint(packages[1])
    assert hashes[0].isdisjoint(hashes[1])


def test_another_file_than_the_listed_one_is_refused(tmp_path, hiss):
    folder = tmp_path / "unpacked" / "sounds_1"
    folder.mkdir(parents=True)
    shutil.copy(hiss, folder / "hiss.wav")
    seen = hashlib.sha256((folder / "hiss.wav").read_bytes()).hexdigest()
    source = {"package": "sounds", "version": "1", "archive": None, "files": {"hiss.wav": seen}}
    (wave,) = room_recordings.read(source, tmp_path)
    assert len(wave) == 8000
    with pytest.raises(ValueError, match="give sounds 1"):
        room_recordings.read(source | {"files": {"hiss.wav": "0" * 64}}, tmp_path)
    mixed = room_recordings.mix("footsteps", [wave], np.random.default_rng(0))
    assert len(mixed) == room_recordings.SECONDS * room_recordings.RATE
    assert 0.9 < np.abs(mixed).max() < 1


NOISES = ("hum", "speech_like", "music_like", "clatter", "hammering", "typing", "tool")


@pytest.mark.slow
def test_the_recordings_of_the_example_suit_environment_and_policy(tmp_path, monkeypatch, capsys):
    example = Path(__file__).parent.parent / "examples" / "room_noise.py"
    for seed in ("1", "2"):
        monkeypatch.setattr(sys, "argv", ["room_noise.py", str(tmp_path / seed), "--seconds=3", "--seed", seed])
        runpy.run_path(str(example), run_name="__main__")
        printed = capsys.readouterr().out.split()
    assert [Path(path).stem for path in printed] == [*NOISES]
    spectra, (_, silent) = [], heard(None, microphones=("gripper",), noise_level=0.0)
    for path in printed:
        rate, samples = wavfile.read(path)
        assert (rate, len(samples)) == (48000, 144000)
        other = wavfile.read(str(path).replace("/2/", "/1/"))[1]
        assert not np.array_equal(samples, other)  # another seed is another recording
        power = signal.welch(samples / 32768, rate, nperseg=4096)[1]
        spectra.append(power / power.sum())
        _, sound = heard(
            PlaybyearEnvConfig(room_noise=path).gym_kwargs["room"], microphones=("gripper",), noise_level=0.0
        )
        assert np.abs(sound - silent).max() > 5 / 32767
    overlap = [np.minimum(a, b).sum() for a, b in itertools.combinations(spectra, 2)]
    assert max(overlap) < 0.7  # each of its own kind
    noise = RecordedNoise(tmp_path / "2", 16000)
    assert len(noise) == len(NOISES)
