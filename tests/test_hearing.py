"""How the policy hears: the paper's spectrogram at every sample rate, noise of rooms and other microphones in training."""

import json
import math
import shutil

import av
import numpy as np
import pytest
import torch
from support.policy import batch_of, make_config, make_episode, make_policy, step_through

from lerobot_playbyear.audio.audio_files import write_audio
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.policy import sound_augmentation
from lerobot_playbyear.policy.generated_noise import STREAMS, STRUCK, GeneratedNoise
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy
from lerobot_playbyear.policy.networks import AudioEncoder
from lerobot_playbyear.policy.sound_augmentation import RecordedNoise, SoundAugmentation
from lerobot_playbyear.policy.spectrogram import LogSpectrogram, SharedStretches, to_float_wave
from lerobot_playbyear.training.command_line import RECIPES

SEGMENT_S, HOP_S, N_BINS, WINDOW_S, RATE = 0.040, 0.035, 160, 2.0, 16000


def make_spectrogram(sample_rate: int, **options) -> LogSpectrogram:
    return LogSpectrogram(sample_rate, SEGMENT_S, HOP_S, N_BINS, **options)


def tone_wave(frequency: float, sample_rate: int, amplitude: float = 0.5) -> torch.Tensor:
    time = torch.arange(round(WINDOW_S * sample_rate), dtype=torch.float64) / sample_rate
    return (amplitude * torch.sin(2 * math.pi * frequency * time)).float()[None]


def noise(n_items: int, n_samples: int, seed: int = 0) -> torch.Tensor:
    return 0.05 * torch.randn(n_items, n_samples, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("sample_rate", [8000, 16000, 44100])
def test_two_seconds_are_57_columns_of_160_bins_in_which_a_tone_of_1_khz_is_as_loud_at_every_rate(sample_rate):
    levels = make_spectrogram(sample_rate).log_power(tone_wave(1000, sample_rate))
    assert levels.shape == (1, 160, 57)
    assert (levels.argmax(dim=1) == 40).all()
    torch.testing.assert_close(10 ** levels[0, 40], torch.full((57,), 0.25), rtol=0.01, atol=0)


def test_statistics_come_from_the_episode_only_and_what_precedes_it_is_the_average():
    spectrogram = make_spectrogram(16000)
    wave = noise(4, 32000)
    begun = torch.zeros(4, 32000, dtype=torch.bool)
    begun[:, 16000:] = True
    wave[:, :16000] = 0.9  # what stands there must not matter
    normalised = spectrogram.train()(wave, begun)
    first = math.ceil(16000 / 560)  # first column that begins with the episode
    assert (normalised[..., :first] == 0).all()
    inside = normalised[..., first:]
    assert inside.mean(dim=(0, 2)).abs().max() < 1e-3
    torch.testing.assert_close(inside.std(dim=(0, 2)), torch.ones(160), rtol=0.02, atol=0)


def test_integers_are_pcm_at_full_scale_and_floats_are_already_scaled():
    half = torch.full((1, 8), 16384)
    for dtype in (torch.int16, torch.int64):
        torch.testing.assert_close(to_float_wave(half.to(dtype), "key"), torch.full((1, 8), 0.5))
    torch.testing.assert_close(to_float_wave(torch.full((1, 8), 0.25), "key"), torch.full((1, 8), 0.25))


@pytest.mark.parametrize(
    ("value", "message"), [(float("nan"), "NaN"), (float("inf"), "infinite"), (-3000.0, "float samples up to 3000")]
)
def test_sound_that_cannot_be_is_refused_with_its_key(value, message):
    wave = torch.zeros(2, 8)
    wave[1, 3] = value
    with pytest.raises(ValueError, match=rf"observation\.audio\.gripper.*{message}"):
        to_float_wave(wave, "observation.audio.gripper")


def test_what_the_reference_microphone_hears_too_is_not_heard():
    """A voice changes no action, whatever the two microphones' gains are; what the arm's alone hears does."""
    two = {"microphones": ("gripper", "room"), "audio_envelope_gain": 3.0}
    policy = make_policy(**two, reference_microphone="room")
    ears = policy.model.spectrogram
    ears["audio_room"].mean.copy_(ears["audio_gripper"].mean - 1.5)  # hears 15 dB less of everything
    episode = make_episode(seed=1, config=policy.config, n_frames=10)
    noise, bang = episode["observation.audio.gripper"], 6 * episode["observation.audio.room"][-3:]

    def actions(policy, gripper, room):
        heard = {name: noise.clone() for name in ("gripper", "room")}
        heard["gripper"][-3:] += gripper * bang
        heard["room"][-3:] += room * bang
        heard["room"] = (heard["room"] / 10**0.75).to(torch.int16)
        return step_through(policy, [episode | {f"observation.audio.{name}": wave for name, wave in heard.items()}])[0]

    def changes(policy, gripper, room):
        return float((actions(policy, gripper, room) - actions(policy, 0, 0)).abs().max())

    assert 10 * changes(policy, 1, 1) < changes(make_policy(**two), 1, 1)
    assert 10 * changes(policy, 1, 1) < changes(policy, 1, 0)


@pytest.mark.parametrize(("microphones", "name"), [(("gripper",), "gripper"), (("gripper", "table"), "room")])
def test_a_reference_microphone_that_is_not_there_or_alone_is_refused(microphones, name):
    config = make_config(microphones=microphones, reference_microphone=name)
    with pytest.raises(
        ValueError,
        match=rf"reference_microphone={name} must be one of two microphones or more; there are: {microphones[0]}",
    ):
        PlaybyearPolicy(config)


@pytest.mark.parametrize(("sample_rate", "fps"), [(16000, 20), (48000, 30), (16000, 5)])
@pytest.mark.parametrize("n_windows", [1, 17])
def test_windows_that_share_segments_are_encoded_as_each_alone(sample_rate, fps, n_windows):
    step, length = sample_rate // fps, round(WINDOW_S * sample_rate)
    spectrogram, encoder = make_spectrogram(sample_rate).eval(), AudioEncoder(N_BINS, 57, (8, 6, 4, 2))
    wave = noise(2, length + (n_windows - 1) * step + 11)
    begun = torch.arange(wave.shape[1]).expand(2, -1) >= torch.tensor([[0], [length]])
    shared = SharedStretches(n_windows, step, length, spectrogram.hop)

    together = shared.windows(
        encoder(spectrogram(shared.stretches(wave), shared.stretches(begun))), encoder.window_columns
    )

    alone = [part[:, 11:].unfold(1, length, step).flatten(0, 1) for part in (wave, begun)]
    torch.testing.assert_close(together, encoder(spectrogram(*alone)), rtol=1e-5, atol=1e-5)


# Noise and other microphones in training


def augmentation(**options):
    return SoundAugmentation(make_config(**options))


def added(augment, n_items=400, n_samples=32000, n_microphones=1):
    """The noise that is mixed into batches of white noise, in units of its floor: (n_items, n_microphones, n_samples)."""
    torch.manual_seed(0)
    waves = 1e-3 * torch.randn(n_items, n_microphones, n_samples)
    return torch.cat([(augment(wave)[0] - wave) / 1e-3 for wave in waves.split(25)])


def decibels(waves):
    return 20 * torch.log10(waves.square().mean(dim=-1).sqrt())


def test_a_microphones_own_noise_is_as_loud_as_asked_for_white_to_pink_and_hums():
    noise = added(augmentation(audio_noise_db=18.0, n_frequency_bins=320))[:, 0]
    level = decibels(noise)
    assert -21 < level.min() < -17  # the hum may be as loud as the broadband noise: 3 dB more, a lucky draw 6
    assert 15 < level.max() < 24
    torch.testing.assert_close(level.mean(), torch.tensor(0.0), rtol=0, atol=2.0)
    power = torch.fft.rfft(noise).abs().square()  # bins of 0.5 Hz
    octaves = torch.stack([power[:, low : 2 * low].mean(dim=1).log2() for low in (800, 1600, 3200, 6400)], dim=1)
    slope = (octaves[:, 0] - octaves[:, -1]) / 3  # the exponent of 1 / frequency
    assert slope.min() < 0.15
    assert slope.max() > 1.05
    torch.testing.assert_close(slope.mean(), torch.tensor(0.6), rtol=0, atol=0.08)
    low = power[:, 60:200]  # 30 to 100 Hz
    hums = low.amax(dim=1) > 30 * low.median(dim=1).values
    assert hums.float().mean() > 0.5
    assert len(low.argmax(dim=1)[hums].unique()) > 30
    silence = torch.zeros(3, 1, 1600)
    torch.testing.assert_close(augmentation(audio_noise_db=18.0)(silence)[0], silence)


def heard_in_training(n_batches=8, **options):
    """What the preset `cpu` mixes into its batches' sound, in units of the floor: (items, samples)."""
    recipe = json.loads((RECIPES / "cpu.json").read_text())
    kept = ("audio_noise_db", "n_memory_steps", "n_supervised_steps")
    augment = augmentation(**{name: recipe["policy"][name] for name in kept}, **options)
    torch.manual_seed(0)
    waves = 1e-3 * torch.randn(n_batches, recipe["batch_size"], 1, 59200)
    return torch.cat([(augment(wave)[0] - wave)[:, 0] / 1e-3 for wave in waves])


def unsteady(noise):
    """Between the loudest and the median 50 ms of each item [dB]: 1 to 2 of noise that is steady."""
    levels = decibels(noise.unflatten(1, (-1, 800)))
    return levels.amax(dim=1) - levels.median(dim=1).values


def test_training_in_rooms_with_people():
    """Most items hear something that is not steady, as voices and blows are; without the option none does."""
    noise = heard_in_training(audio_room_noise=True)
    assert (unsteady(heard_in_training()) < 6).all()
    assert 0.35 < (unsteady(noise) > 6).float().mean() < 0.85
    others = noise[decibels(noise) > 0]
    spectra = torch.fft.rfft(others).abs().square()[:, : 74 * 168].unflatten(1, (-1, 148)).sum(dim=2)  # of 40 Hz each
    shares = spectra / spectra.sum(dim=1, keepdim=True)
    overlap = torch.minimum(shares[:, None], shares).sum(dim=2)
    assert overlap.median() < 0.6  # each of its own colour


@pytest.mark.parametrize("kind", [*STRUCK, *STREAMS])
def test_every_kind_is_another_each_time_and_as_loud_as_the_others(kind):
    torch.manual_seed(0)
    made = GeneratedNoise()
    if kind in STRUCK:
        spectra = made.struck(torch.full((4,), STRUCK.index(kind)), 3.7, 15000)
    else:
        spectra = torch.stack([made.stream(kind, 3.7, 15000) for _ in range(4)])
    clips = wave(spectra)
    torch.testing.assert_close(decibels(clips), torch.zeros(4), rtol=0, atol=0.01)
    likeness = clips @ clips.T / 30000
    assert (likeness - torch.eye(4)).abs().max() < 0.5


def test_items_hear_all_kinds_and_share_a_few_clips_of_a_batch():
    torch.manual_seed(0)
    made, seen = GeneratedNoise(), []
    made.struck = lambda kinds, *_: torch.complex(kinds.float(), kinds * 0.0).unsqueeze(1)
    made.stream = lambda kind, *_: torch.tensor([4.0 + [*STREAMS].index(kind)]).to(torch.complex64)
    for _ in range(300):
        batch = made(3.7, 1, 12).real.flatten()
        assert len(batch.unique()) <= 4
        seen.append(batch)
    shares = torch.cat(seen).long().bincount() / 3600
    torch.testing.assert_close(shares, torch.full((6,), 1 / 6), rtol=0, atol=0.03)


def wave(spectra):
    """As `GeneratedNoise` means it."""
    return torch.fft.irfft(torch.nn.functional.pad(spectra, (1, 0)), norm="forward")


def likeness(pairs):
    """Of two microphones' noise, (N, 2, samples): largest correlation, and how much later the second hears it."""
    spectra = torch.fft.rfft(pairs - pairs.mean(dim=2, keepdim=True))
    across = torch.fft.irfft(spectra[:, 1] * spectra[:, 0].conj(), n=pairs.shape[2])
    across = torch.cat([across[:, -240:], across[:, :241]], dim=1) / pairs.norm(dim=2).prod(dim=1, keepdim=True)
    best = across.abs().max(dim=1)
    return best.values, best.indices - 240


def test_all_microphones_hear_the_same_source_each_in_its_own_way(monkeypatch):
    """Later, by reflections of its own and not equally loud; in an empty room they have nothing in common."""
    augment = augmentation(microphones=("gripper", "room"), audio_noise_db=20.0, audio_room_noise=True)
    monkeypatch.setattr(sound_augmentation, "_ROOM_SHARE", 1.0)
    with monkeypatch.context() as quiet:
        quiet.setattr(augment, "_own", lambda *_: torch.zeros(()))
        together = added(augment, n_microphones=2)
    alike, later = likeness(together)
    assert alike.median() > 0.4
    assert alike.min() > 0.02
    assert len(later.unique()) > 20
    difference = decibels(together).diff(dim=1)
    assert 1.5 < difference.abs().mean() < 5
    assert decibels(together).amax() < 20  # 6 dB less than was asked for, and a room may raise a tone
    monkeypatch.setattr(sound_augmentation, "_ROOM_SHARE", 0.0)
    alone, _ = likeness(added(augment, n_microphones=2))
    assert alone.median() < 0.2  # hums may meet


def test_beside_a_reference_microphone_the_background_and_the_response_are_one():
    augment = augmentation(microphones=("gripper", "room"), audio_noise_db=20.0, reference_microphone="room")
    levels = decibels(added(augment, n_microphones=2))
    assert levels.diff(dim=1).abs().mean() < 1
    assert levels[:, 0].std() > 5
    gains = augment.colour(20, 2)
    assert torch.equal(gains[:, 0], gains[:, 1])


def tone(frequency, rate, seconds=2.0, amplitude=0.1):
    return amplitude * np.sin(2 * np.pi * frequency * np.arange(int(seconds * rate)) / rate)


@pytest.fixture
def recordings(tmp_path):
    """A tone of 500 Hz in a WAV of 48 kHz and two channels, and one of 1,500 Hz, ten times as loud, in a FLAC of 16 kHz."""
    folder = tmp_path / "noise"
    (folder / "deep").mkdir(parents=True)
    write_audio(folder / "low.wav", np.stack([tone(500, 48000), tone(500, 48000)], axis=1), 48000)
    write_audio(folder / "deep" / "high.flac", tone(1500, RATE, amplitude=0.9)[:, None], RATE)
    (folder / "README.txt").write_text("not a recording")
    return folder


def pitch_of(waves):
    """Loudest frequency of each item [Hz]."""
    return torch.fft.rfft(waves).abs().argmax(dim=1) * RATE / waves.shape[1]


def test_excerpts_come_from_every_recording_at_one_loudness_and_from_all_over(recordings):
    torch.manual_seed(0)
    found = RecordedNoise(recordings, RATE).excerpts(200, 4000)
    assert set(pitch_of(found).tolist()) == {500.0, 1500.0}
    torch.testing.assert_close(found.square().mean(dim=1).sqrt(), torch.ones(200), rtol=0, atol=0.02)
    assert len(found[:, 0].unique()) > 10  # phases of the tones


def test_half_of_what_items_hear_of_a_room_is_recorded_and_none_louder_than_was_asked_for(recordings, monkeypatch):
    """Recorded are two tones."""
    monkeypatch.setattr(SoundAugmentation, "_own", lambda *_: torch.zeros(()))
    mixed = augmentation(audio_noise_db=20.0, audio_room_noise=True, audio_noise_files=str(recordings))
    noise = added(mixed, 300, 8000)[:, 0]
    level = decibels(noise)
    assert 0.68 < (level > -60).float().mean() < 0.82
    power = torch.fft.rfft(noise).abs().square()  # bins of 2 Hz
    tones = power[:, 235:266].sum(dim=1) + power[:, 735:766].sum(dim=1)
    recorded = (tones > 0.98 * power.sum(dim=1)) & (level > -60)
    assert 0.28 < recorded.float().mean() < 0.47
    assert -21 < level[recorded].min() < -9  # 6 dB below the floor, and a room may lower a tone
    assert 10 < level[recorded].max() < 18  # 6 dB less than was asked for, and a room may raise a tone


def test_a_folder_that_cannot_be_used_is_refused_with_what_to_do(recordings, tmp_path, monkeypatch):
    monkeypatch.setattr(sound_augmentation, "_MOST_SECONDS", 3)
    with pytest.raises(InputError, match="take some out"):  # more than fits into memory
        RecordedNoise(recordings, RATE)
    monkeypatch.undo()
    shutil.rmtree(recordings)
    with pytest.raises(InputError, match=r"--policy.audio_noise_files=.*holds no .wav or .flac file"):
        RecordedNoise(tmp_path, RATE)
    secret = write_audio(tmp_path / "elsewhere" / "secret.flac", tone(300, RATE)[:, None], RATE)
    (tmp_path / "noise").mkdir()
    (tmp_path / "noise" / "a.wav").write_text(f"ffconcat version 1.0\nfile '{secret}'\n")  # FFmpeg would open it
    with pytest.raises(InputError, match=r"holds no .wav or .flac file with sound"):
        RecordedNoise(tmp_path / "noise", RATE)
    write_audio(tmp_path / "noise" / "a.wav", np.zeros((RATE, 1)), RATE)
    with pytest.raises(InputError, match=r"a\.wav is silent"):
        RecordedNoise(tmp_path / "noise", RATE)


def test_files_that_hold_no_sound_are_left_out_of_a_folder_and_told(recordings, caplog):
    """And others are read as what they are, whatever their names say."""
    head = b"RIFF\x24\0\0\0WAVEfmt \x10\0\0\0\1\0\1\0"
    pcm = b"\2\0\x10\0data"
    nothing = {
        "._low.wav": b"\0\5\x16\7\0\2\0\0Mac OS X        " + bytes(4000),  # beside every file on a Mac's USB stick
        "notes.wav": b"the tone is in low.wav\n",
        "list.wav": b"ffconcat version 1.0\nfile 'low.wav'\n",
        "empty.wav": b"",
        "no_samples.wav": head + b"\x80\x3e\0\0\0\x7d\0\0" + pcm + bytes(4),
        "no_rate.wav": head + bytes(8) + pcm + b"\4\0\0\0" + bytes(4),
        "odd_codec.wav": head[:-4] + b"\x99\x99\1\0" + b"\x80\x3e\0\0\0\x7d\0\0" + pcm + b"\4\0\0\0" + bytes(4),
        "cut.flac": b"fLaC\0\0\0",
    }
    for name, content in nothing.items():
        (recordings / name).write_bytes(content)
    sound = write_audio(recordings / "mid.flac", tone(1000, RATE)[:, None], RATE)
    sound.rename(recordings / "mid.wav")
    with av.open(str(recordings / "aiff.wav"), "w", format="aiff") as file:
        stream = file.add_stream("pcm_s16be", rate=RATE, layout="mono")
        block = (32000 * tone(2000, RATE)).astype(np.int16)[None]
        frame = av.AudioFrame.from_ndarray(block, format="s16", layout="mono")
        frame.sample_rate = RATE
        file.mux(stream.encode(frame))
    torch.manual_seed(0)
    found = RecordedNoise(recordings, RATE)
    assert set(pitch_of(found.excerpts(200, 4000)).tolist()) == {500.0, 1000.0, 1500.0, 2000.0}
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == len(nothing)
    for name in nothing:
        assert any(name in line and "left out" in line for line in said), name


def test_training_reads_the_folder_and_acting_does_not(recordings, tmp_path):
    policy = make_policy(audio_noise_db=20.0, audio_noise_files=str(recordings), n_supervised_steps=1)
    for path in recordings.rglob("*.*"):
        path.unlink()
    policy.save_pretrained(tmp_path / "checkpoint")
    again = PlaybyearPolicy.from_pretrained(tmp_path / "checkpoint")
    assert torch.equal(
        step_through(again, [make_episode(3, again.config)]), step_through(policy, [make_episode(3, policy.config)])
    )
    with pytest.raises(InputError, match="audio_noise_files"):
        again.train().forward(batch_of(again))


def test_in_a_room_another_microphone_hears_each_item_with_a_smooth_response():
    torch.manual_seed(0)
    gains = 10 * augmentation(audio_noise_db=18.0).colour(1000, 2).flatten(0, 1)  # [dB]
    assert gains.shape == (2000, 160)
    deviation = gains.std(dim=0)
    assert deviation.min() > 2.5  # between two points it is their mean
    assert 3.7 < deviation.max() < 4.3
    assert gains.mean().abs() < 0.2
    steps = gains.diff(dim=1).abs().mean(dim=0)
    assert steps[40:].max() < 0.2  # 25 Hz further
    quiet = torch.randn(2, 1, 800)
    noisy, gains = augmentation()(quiet)
    assert noisy is quiet
    assert gains is None
    assert augmentation(audio_noise_db=18.0)(quiet)[1] is None
    assert augmentation(audio_noise_db=18.0, audio_room_noise=True)(quiet)[1].shape == (2, 1, 160)


def test_one_item_has_one_microphone_in_all_its_windows():
    """Its windows share stretches of sound: every one of them must be coloured alike, and no other item's way."""
    policy = make_policy(audio_noise_db=6.0, audio_room_noise=True, n_supervised_steps=6, augmentation_crop=0.0).train()
    policy.keep_normalization()
    batch, seen = batch_of(policy), []
    ear = next(module for module in policy.model.modules() if isinstance(module, LogSpectrogram))
    ear.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[2]))
    policy.forward(batch)
    colour = seen[0].unflatten(0, (2, -1))  # (items, stretches, bins)
    assert colour.shape[1] > 1
    assert torch.equal(colour, colour[:, :1].expand_as(colour))
    assert not torch.allclose(colour[0, 0], colour[1, 0], atol=0.1)
