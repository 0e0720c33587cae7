"""The policy's ear: the grid of the paper, the same picture at every sample rate, statistics of real sound only."""

import json
import math

import pytest
import torch
from torchaudio.functional import resample

from lerobot_playbyear.policy.configuration_playbyear import segment_and_hop
from lerobot_playbyear.policy.networks import AudioEncoder
from lerobot_playbyear.policy.spectrogram import LogSpectrogram, SharedStretches, to_float_wave
from lerobot_playbyear.training.presets import RECIPES

SEGMENT_S, HOP_S, N_BINS, WINDOW_S = 0.040, 0.035, 160, 2.0


def make_spectrogram(sample_rate: int, **options) -> LogSpectrogram:
    return LogSpectrogram(sample_rate, SEGMENT_S, HOP_S, N_BINS, **options)


def tone(frequency: float, sample_rate: int, amplitude: float = 0.5) -> torch.Tensor:
    time = torch.arange(round(WINDOW_S * sample_rate), dtype=torch.float64) / sample_rate
    return (amplitude * torch.sin(2 * math.pi * frequency * time)).float()[None]


def noise(n_items: int, n_samples: int, seed: int = 0) -> torch.Tensor:
    return 0.05 * torch.randn(n_items, n_samples, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("sample_rate", [8000, 16000, 22050, 44100, 48000])
def test_two_seconds_are_57_columns_of_160_bins_at_every_sample_rate(sample_rate):
    assert make_spectrogram(sample_rate).log_power(tone(440, sample_rate)).shape == (1, 160, 57)


@pytest.mark.parametrize("sample_rate", [16000, 48000])
def test_a_tone_of_1_khz_peaks_in_bin_40_of_every_column(sample_rate):
    levels = make_spectrogram(sample_rate).log_power(tone(1000, sample_rate))
    assert (levels.argmax(dim=1) == 40).all()


def test_the_level_of_a_tone_does_not_depend_on_the_sample_rate():
    low, high = (make_spectrogram(rate).log_power(tone(1000, rate))[0, 40] for rate in (16000, 48000))
    torch.testing.assert_close(10**low, 10**high, rtol=0.01, atol=0)


def test_resampled_sound_has_the_same_spectrogram_within_one_percent():
    sound = noise(1, 96000)
    sound = resample(sound, 48000, 12000, lowpass_filter_width=64)  # nothing near the resampler's cut-off below
    at_48k = resample(sound, 12000, 48000, lowpass_filter_width=64)
    at_16k = resample(sound, 12000, 16000, lowpass_filter_width=64)
    expected = make_spectrogram(48000).log_power(at_48k)
    levels = make_spectrogram(16000).log_power(at_16k)
    # The resampler's own edges are in the first and the last column.
    error = (levels - expected)[..., 1:-1].abs() / expected[..., 1:-1].abs()
    assert error.max() < 0.01


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


def test_statistics_stand_still_in_evaluation_and_without_real_sound():
    spectrogram = make_spectrogram(16000)
    spectrogram.train()(noise(2, 32000), torch.ones(2, 32000, dtype=torch.bool))
    before = {name: buffer.clone() for name, buffer in spectrogram.state_dict().items()}
    spectrogram.train()(5 * noise(2, 32000), torch.zeros(2, 32000, dtype=torch.bool))
    spectrogram.eval()(5 * noise(2, 32000), torch.ones(2, 32000, dtype=torch.bool))
    for name, buffer in spectrogram.state_dict().items():
        torch.testing.assert_close(buffer, before[name], rtol=0, atol=0)


def test_kept_statistics_stand_still_in_training_which_then_hears_what_acting_does():
    spectrogram = make_spectrogram(16000)
    loud, begun = 5 * noise(2, 32000), torch.ones(2, 32000, dtype=torch.bool)
    spectrogram.train()(noise(2, 32000), begun)
    before = {name: buffer.clone() for name, buffer in spectrogram.state_dict().items()}
    spectrogram.keeps_statistics = True
    in_training = spectrogram.train()(loud, begun)
    assert torch.equal(in_training, spectrogram.eval()(loud, begun))
    assert all(torch.equal(buffer, before[name]) for name, buffer in spectrogram.state_dict().items())


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


def test_a_sample_rate_too_low_for_the_bins_is_refused():
    with pytest.raises(ValueError, match="at least 8000 Hz, got 6000"):
        make_spectrogram(6000)


@pytest.mark.parametrize(("sample_rate", "fps"), [(16000, 20), (48000, 30), (16000, 5), (16000, 40)])
@pytest.mark.parametrize("n_windows", [1, 4, 17, 41])
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


def test_seventeen_frames_at_20_hz_cost_half_the_segments():
    shared = SharedStretches(17, step=800, length=32000, hop=560)
    assert (shared.period, shared.n_stretches, shared.windows_per_stretch) == (7, 7, 3)
    segments = shared.n_stretches * ((32000 + 2 * 7 * 800 - 640) // 560 + 1)
    assert segments < 17 * 57 * 0.56


@pytest.mark.parametrize(("sample_rate", "fps"), [(16000, 20), (48000, 5)])
def test_with_the_step_of_the_preset_neighbouring_windows_share_all_columns(sample_rate, fps):
    hop_s = json.loads((RECIPES / "cpu.json").read_text())["policy"]["hop_s"]
    _, hop = segment_and_hop(sample_rate, SEGMENT_S, hop_s)
    shared = SharedStretches(35, sample_rate // fps, 2 * sample_rate, hop)
    assert (shared.period, shared.n_stretches) == (1, 1)


def test_sound_that_is_taken_apart_to_fit_a_cache_gives_the_same_bits():
    wave, ear = 0.1 * torch.randn(9, 400_000, generator=torch.Generator().manual_seed(0)), make_spectrogram(48000)
    assert torch.equal(ear.power(wave), torch.cat([ear.power(row[None]) for row in wave]))
    assert torch.equal(ear.power(wave), ear._power(wave))
