"""Sound in training: noise of rooms, recorded noise, and other microphones; a policy that acts knows nothing of it."""

import math

import numpy as np
import pytest
import torch
from test_policy_contract import make_config, make_episode, make_policy, step_through
from test_policy_training import batch_of

from lerobot_playbyear.datasets.audio_files import write_audio
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.policy import sound_augmentation
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy
from lerobot_playbyear.policy.sound_augmentation import RecordedNoise, SoundAugmentation, mix_in_noise
from lerobot_playbyear.policy.spectrogram import LogSpectrogram

RATE = 16000


def mixed_in(n_items: int, max_db: float, floor: float = 1e-3, n_samples: int = 32000) -> torch.Tensor:
    """The noise that is mixed into white noise of this floor, in units of the floor: (n_items, n_samples)."""
    torch.manual_seed(0)
    wave = floor * torch.randn(n_items, n_samples)
    return (mix_in_noise(wave, max_db, 16000) - wave) / floor


def test_noise_in_training_is_as_loud_as_asked_for_and_seldom_so():
    level = 20 * torch.log10(mixed_in(400, 18.0).square().mean(dim=1).sqrt())
    assert -21 < level.min() < -17  # the hum may be as loud as the broadband noise: 3 dB more, a lucky draw 6
    assert 15 < level.max() < 24
    torch.testing.assert_close(level.mean(), torch.tensor(0.0), rtol=0, atol=2.0)


def test_noise_in_training_is_white_pink_and_what_lies_between():
    power = torch.fft.rfft(mixed_in(200, 0.0)).abs().square()  # bins of 0.5 Hz
    octaves = torch.stack([power[:, low : 2 * low].mean(dim=1).log2() for low in (800, 1600, 3200, 6400)], dim=1)
    slope = (octaves[:, 0] - octaves[:, -1]) / 3  # the exponent of 1 / frequency
    assert slope.min() < 0.15
    assert slope.max() > 1.05
    torch.testing.assert_close(slope.mean(), torch.tensor(0.6), rtol=0, atol=0.08)


def test_noise_in_training_hums_at_another_pitch_in_every_item():
    power = torch.fft.rfft(mixed_in(200, 0.0)).abs().square()[:, :200]  # up to 100 Hz
    loudest = power[:, 60:].argmax(dim=1) / 2 + 30  # [Hz]
    hums = power[:, 60:].amax(dim=1) > 30 * power[:, 60:].median(dim=1).values
    assert hums.float().mean() > 0.5
    assert ((loudest[hums] > 44) & (loudest[hums] < 101)).all()
    assert len(loudest[hums].unique()) > 30


def test_sound_without_a_floor_stays_as_it_is():
    wave = torch.zeros(3, 1600)
    torch.testing.assert_close(mix_in_noise(wave, 18.0, 16000), wave)


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


def test_recordings_of_another_rate_are_read_in_the_middle_of_training_in_bfloat16(recordings):
    expected = RecordedNoise(recordings, RATE // 2)
    with torch.autocast("cpu", torch.bfloat16):
        found = RecordedNoise(recordings, RATE // 2)
    assert all(torch.equal(a, b) for a, b in zip(found._recordings, expected._recordings, strict=True))


def test_a_recording_that_is_shorter_than_an_excerpt_repeats(tmp_path):
    write_audio(tmp_path / "click.wav", tone(1000, RATE, seconds=0.25)[:, None], RATE)
    found = RecordedNoise(tmp_path, RATE).excerpts(3, RATE)
    torch.testing.assert_close(found[:, : RATE // 2], found[:, RATE // 2 :])
    assert (pitch_of(found) == 1000).all()


def augmentation(**options):
    return SoundAugmentation(make_config(**options))


def test_noise_above_what_is_heard_is_left_out_and_the_rest_is_as_loud():
    wave, ear = torch.zeros(600, 8000), LogSpectrogram(RATE, 0.04, 0.035, 80).eval()  # hears up to 2 kHz
    wave[:, ::2] = 1e-3
    powers = []
    for highest_hz in (math.inf, augmentation(audio_noise_db=20.0, n_frequency_bins=80).highest_hz):
        torch.manual_seed(2)
        noise = mix_in_noise(wave, 20.0, RATE, highest_hz) - wave
        powers.append(ear.power(noise).mean(dim=(0, 2)))
    above = torch.fft.rfft(noise).abs()[:, 8000 * 2300 // RATE :]
    assert above.max() < 1e-4
    torch.testing.assert_close(powers[1][14:], powers[0][14:], rtol=0.25, atol=0)  # above any hum
    torch.testing.assert_close(powers[1].sum(), powers[0].sum(), rtol=0.1, atol=0)


def test_three_quarters_of_the_items_get_recorded_noise_and_none_more_than_was_asked_for(recordings):
    torch.manual_seed(0)
    augment, wave = augmentation(audio_noise_db=20.0, audio_noise_files=str(recordings)), 1e-4 * torch.randn(300, 8000)
    torch.manual_seed(1)
    room = mix_in_noise(wave, 20.0, RATE, augment.highest_hz)
    torch.manual_seed(1)
    recorded = (augment.noisy(wave) - room) / 1e-4  # in units of the floor
    level = 20 * torch.log10(recorded.square().mean(dim=1).sqrt())
    with_noise = level > -60
    assert 0.68 < with_noise.float().mean() < 0.82
    assert -1.5 < level[with_noise].min() < 1.5
    assert 18.5 < level[with_noise].max() < 21.5
    torch.testing.assert_close(level[with_noise].mean(), torch.tensor(10.0), rtol=0, atol=1.5)


def test_recorded_noise_is_never_louder_than_asked_for_where_that_is_below_the_floor(recordings):
    torch.manual_seed(0)
    augment, wave = augmentation(audio_noise_db=-6.0, audio_noise_files=str(recordings)), 1e-4 * torch.randn(100, 8000)
    torch.manual_seed(1)
    room = mix_in_noise(wave, -6.0, RATE, augment.highest_hz)
    torch.manual_seed(1)
    recorded = (augment.noisy(wave) - room) / 1e-4
    assert 20 * torch.log10(recorded.square().mean(dim=1).sqrt()).max() < -4.5


def spoil(folder, how):
    if how == "missing":
        return folder / "nowhere", "there is no such folder"
    for path in list(folder.rglob("*.*")):
        path.unlink()
    if how == "empty":
        return folder, "holds no .wav or .flac file"
    if how == "text":
        (folder / "a.wav").write_text("this is no sound")
        return folder, r"a\.wav.*cannot be decoded.*take it out of the folder"
    if how == "playlist":  # FFmpeg would open what it names
        secret = write_audio(folder.parent / "secret.flac", tone(300, RATE)[:, None], RATE)
        (folder / "a.wav").write_text(f"ffconcat version 1.0\nfile '{secret}'\n")
        return folder, r"a\.wav.*cannot be decoded"
    write_audio(folder / "a.wav", np.zeros((RATE, 1)), RATE)
    return folder, r"a\.wav is silent"


@pytest.mark.parametrize("how", ["missing", "empty", "text", "playlist", "silent"])
def test_a_folder_that_cannot_be_used_is_refused_with_what_to_do(recordings, how):
    folder, message = spoil(recordings, how)
    with pytest.raises(InputError, match=rf"--policy.audio_noise_files=.*{message}"):
        RecordedNoise(folder, RATE)


def test_more_than_fits_into_memory_is_refused_before_it_is_read(recordings, monkeypatch):
    monkeypatch.setattr(sound_augmentation, "_MOST_SECONDS", 3)
    with pytest.raises(InputError, match="take some out"):
        RecordedNoise(recordings, RATE)


def test_recorded_noise_without_a_level_is_refused():
    with pytest.raises(
        ValueError, match=r"audio_noise_files=here says nothing of how loud.*--policy.audio_noise_db=24"
    ):
        make_config(audio_noise_files="here")


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


def test_another_microphones_gain_is_smooth_and_as_strong_as_asked_for():
    torch.manual_seed(0)
    gains = 10 * augmentation(audio_colour_db=4.0).colour(2000)  # [dB]
    assert gains.shape == (2000, 160)
    deviation = gains.std(dim=0)
    assert deviation.min() > 2.5  # between two points it is their mean
    assert 3.7 < deviation.max() < 4.3
    assert gains.mean().abs() < 0.2
    steps = gains.diff(dim=1).abs().mean(dim=0)
    assert steps[40:].max() < 0.2  # 25 Hz further
    assert augmentation().colour(5) is None


def test_a_gain_moves_the_spectrogram_by_just_as_much():
    torch.manual_seed(0)
    ear, wave = LogSpectrogram(RATE, 0.04, 0.035, 160).eval(), 0.1 * torch.randn(3, RATE)
    begun, colour = torch.ones_like(wave, dtype=torch.bool), torch.randn(3, 160)
    plain, coloured = ear(wave, begun), ear(wave, begun, colour)
    torch.testing.assert_close(coloured - plain, colour[:, :, None].expand_as(plain), rtol=1e-4, atol=1e-4)


def test_one_item_has_one_microphone_in_all_its_windows():
    """Its windows share stretches of sound: every one of them must be coloured alike, and no other item's way."""
    policy = make_policy(audio_colour_db=6.0, n_supervised_steps=6, augmentation_crop=0.0).train()
    policy.keep_normalization()
    batch, seen = batch_of(policy), []
    ear = next(module for module in policy.model.modules() if isinstance(module, LogSpectrogram))
    ear.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[2]))
    policy.forward(batch)
    colour = seen[0].unflatten(0, (2, -1))  # (items, stretches, bins)
    assert colour.shape[1] > 1
    assert torch.equal(colour, colour[:, :1].expand_as(colour))
    assert not torch.allclose(colour[0, 0], colour[1, 0], atol=0.1)


@pytest.mark.parametrize("value", [-1.0, -0.01])
def test_a_gain_below_nothing_is_refused(value):
    with pytest.raises(ValueError, match=r"--policy\.audio_colour_db must be at least 0 \(none\)"):
        make_config(audio_colour_db=value)
