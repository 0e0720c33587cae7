"""Contact sound: audible exactly when something touches, the same for the same seed, different per material."""

import numpy as np
import pytest
from scipy import signal

from gym_playbyear.sound import MATERIALS, ContactPair, ContactSound, pcm16

BODIES = (
    ("gripper", "cube"),
    ("gripper", "wall"),
    ("gripper", "table"),
    ("gripper", "bin"),
    ("cube", "table"),
)
PAIRS = [ContactPair("-".join(bodies), bodies, bodies) for bodies in BODIES]
CUBE, WALL, TABLE, BIN, RESTING = range(len(PAIRS))
PHYSICS_DT = 0.002
CUBE_WEIGHT = 1.3  # N


def make_sound(seed=0, microphones=("gripper",), sample_rate=16000, control_hz=20, noise_level=1.0):
    sound = ContactSound(PAIRS, microphones, sample_rate, control_hz, PHYSICS_DT, noise_level)
    sound.reset(np.random.default_rng(seed))
    return sound


def no_force(sound, steps=1):
    return np.zeros((steps * sound.n_substeps, len(PAIRS)))


def hear(sound, forces, microphone="gripper", joint_speed=0.2):
    """Samples of as many control steps as `forces` lasts."""
    blocks = forces.reshape(-1, sound.n_substeps, len(PAIRS))
    speed = np.full(sound.n_substeps, joint_speed)
    return np.concatenate([sound.step(block, speed)[microphone] for block in blocks])


def dbfs(samples):
    return 20 * np.log10(np.sqrt(np.mean((samples / 32768.0) ** 2)) + 1e-12)


def touch(pair, newton=2.0, at=10, seed=0, **options):
    """The frame in which a touch happens, after a silent one."""
    sound = make_sound(seed, **options)
    forces = no_force(sound, 2)
    forces[sound.n_substeps + at :, pair] = newton
    return hear(sound, forces)[sound.samples_per_step :]


@pytest.mark.parametrize("microphone", ["gripper", "table"])
@pytest.mark.parametrize("sample_rate", [8000, 16000, 44100, 48000])
def test_without_contact_there_is_only_the_floor(microphone, sample_rate):
    sound = make_sound(microphones=("gripper", "table"), sample_rate=sample_rate)
    samples = hear(sound, no_force(sound, 40), microphone)
    assert samples.dtype == np.int16
    assert samples.shape == (2 * sample_rate,)
    assert -64 < dbfs(samples) < -58
    frames = [dbfs(frame) for frame in samples.reshape(40, -1)]
    assert max(frames) < -54  # no frame could be taken for a touch


def test_noise_level_scales_the_floor_and_zero_silences_it():
    levels = [dbfs(hear(sound, no_force(sound, 10))) for sound in (make_sound(), make_sound(noise_level=4.0))]
    assert levels[1] - levels[0] == pytest.approx(12.0, abs=0.5)
    silent = make_sound(noise_level=0.0)
    assert not hear(silent, no_force(silent, 3)).any()


def test_hum_grows_mildly_with_speed():
    slow, fast = (dbfs(hear(make_sound(), np.zeros((2000, len(PAIRS))), joint_speed=v)) for v in (0.0, 3.0))
    assert 0.2 < fast - slow < 3.0


@pytest.mark.parametrize("at", [0, 12, 24])
@pytest.mark.parametrize("pair", [CUBE, WALL, TABLE, BIN])
def test_touch_stands_20_db_above_the_floor_within_its_frame(pair, at):
    sound = make_sound()
    floor = dbfs(hear(sound, no_force(sound, 20)))
    loudness = [dbfs(touch(pair, newton=1.0, at=at, seed=seed)) - floor for seed in range(10)]
    assert min(loudness) > 20


def test_hard_blow_saturates_softly():
    samples = touch(WALL, newton=50.0)
    assert dbfs(samples) > dbfs(touch(WALL, newton=2.0)) + 6
    assert np.mean(np.abs(samples) > 0.95 * 32767) < 0.02


def test_constant_force_is_silent():
    sound = make_sound(noise_level=0.0)
    forces = no_force(sound, 20)
    forces[30:, CUBE] = 20.0
    blocks = hear(sound, forces).reshape(20, -1)
    assert blocks[1].any()
    assert not blocks[10:].any()


def test_contact_that_lasts_from_before_the_episode_makes_no_click():
    sound = make_sound(noise_level=0.0)
    forces = no_force(sound, 2)
    forces[:, TABLE] = CUBE_WEIGHT
    assert not hear(sound, forces).any()


def test_jitter_of_a_resting_cube_is_inaudible_to_both_microphones():
    sound = make_sound(microphones=("gripper", "table"), noise_level=0.0)
    forces = no_force(sound, 10)
    forces[:, RESTING] = CUBE_WEIGHT + np.random.default_rng(0).uniform(-0.05, 0.05, len(forces))
    assert not hear(sound, forces, "gripper").any()
    sound.reset(np.random.default_rng(0))
    assert not hear(sound, forces, "table").any()


def test_sliding_scrapes_for_as_long_as_it_lasts():
    sound = make_sound()
    forces = no_force(sound, 20)
    forces[250:, WALL] = np.random.default_rng(0).uniform(1.0, 3.0, 250)
    blocks = hear(sound, forces).reshape(20, -1)
    assert min(dbfs(block) for block in blocks[10:]) > -60 + 20


def test_gripper_hears_the_cube_only_faintly_unless_it_holds_it():
    def landing(held):
        sound = make_sound(noise_level=0.0)
        forces = no_force(sound, 20)
        forces[10:, CUBE] = 30.0 if held else 0.0
        forces[480:, RESTING] = 5.0
        return dbfs(hear(sound, forces).reshape(20, -1)[-1])

    assert landing(held=True) - landing(held=False) == pytest.approx(30, abs=3)


def test_table_microphone_hears_the_grasp_of_a_cube_on_the_table_but_not_in_the_air():
    def grasp(lifted):
        sound = make_sound(microphones=("table",), noise_level=0.0)
        forces = no_force(sound, 2)
        forces[:, RESTING] = 0.0 if lifted else CUBE_WEIGHT
        forces[30:, CUBE] = 10.0
        return dbfs(hear(sound, forces, "table")[sound.samples_per_step :])

    assert grasp(lifted=False) - grasp(lifted=True) == pytest.approx(30, abs=3)


def busy_forces(steps):
    """Onsets, scraping and releases on every pair at random."""
    rng = np.random.default_rng(3)
    on = np.repeat(rng.uniform(size=(steps * 5, len(PAIRS))) < 0.2, 5, axis=0)
    return on * rng.uniform(0.5, 3.0, on.shape)


@pytest.mark.parametrize("sample_rate", [16000, 44100])
def test_waveform_does_not_depend_on_where_control_steps_begin(sample_rate):
    forces = busy_forces(20)
    waves = [
        hear(make_sound(sample_rate=sample_rate, control_hz=hz, noise_level=0.0), forces).astype(int)
        for hz in (20, 10, 100)
    ]
    assert np.abs(waves[0]).max() > 1000
    assert np.abs(waves[0] - waves[1]).max() <= 1
    assert np.abs(waves[0] - waves[2]).max() <= 1


def test_same_seed_same_bytes_and_other_seed_other_sound():
    forces = busy_forces(10)
    first, again, other = (hear(make_sound(seed), forces).tobytes() for seed in (5, 5, 6))
    assert first == again
    assert first != other


def test_reset_repeats_the_episode():
    sound, forces = make_sound(5), busy_forces(10)
    first = hear(sound, forces)
    sound.reset(np.random.default_rng(5))
    np.testing.assert_array_equal(hear(sound, forces), first)


def test_second_microphone_leaves_the_first_ones_contacts_as_they_are():
    forces = busy_forces(10)
    alone = hear(make_sound(noise_level=0.0), forces)
    np.testing.assert_array_equal(hear(make_sound(microphones=("gripper", "table"), noise_level=0.0), forces), alone)


def spectrum(wave, sample_rate):
    """Power per hertz below 4 kHz, in bins of 25 Hz."""
    density = signal.welch(wave / 32768.0, sample_rate, nperseg=sample_rate // 25)[1]
    return density[:160]


def test_same_spectrum_at_16_and_48_khz():
    low, high = (
        spectrum(hear(make_sound(sample_rate=rate, noise_level=0.0), busy_forces(40)), rate) for rate in (16000, 48000)
    )
    loud = low > 1e-3 * low.max()
    assert loud.sum() > 20
    assert np.abs(10 * np.log10(low[loud] / high[loud])).max() < 1.0


def test_cube_rings_at_its_modes():
    power = spectrum(touch(CUBE, newton=5.0, at=0), 16000)
    for frequency in MATERIALS["cube"].frequencies[:2]:
        near = slice(int(frequency / 25) - 2, int(frequency / 25) + 4)
        assert power[near].max() > 10 * np.median(power[:100])


def log_spectrogram(samples):
    """Two frames of 50 ms, the lowest 160 bins of 25 Hz."""
    power = np.abs(np.fft.rfft(samples.reshape(2, -1) * np.hanning(800), n=640 * 2)[:, :320:2]) ** 2
    return np.log10(power + 1.0).ravel()


def touches(seeds):
    """Log spectrograms of touches at random force and time, and which of cube, wall and table was touched."""
    features, labels = [], []
    for seed in seeds:
        rng = np.random.default_rng([9, seed])
        label = int(rng.integers(3))
        sound = make_sound(seed)
        forces = no_force(sound, 3)
        forces[:, RESTING] = CUBE_WEIGHT
        start = sound.n_substeps + int(rng.integers(sound.n_substeps))
        rise = np.clip(np.arange(1, len(forces) - start + 1) / rng.integers(1, 5), 0.0, 1.0)
        forces[start:, (CUBE, WALL, TABLE)[label]] = rise * np.exp(rng.uniform(np.log(1.0), np.log(30.0)))
        features.append(log_spectrogram(hear(sound, forces)[sound.samples_per_step :]))
        labels.append(label)
    return np.array(features), np.array(labels)


def test_linear_classifier_tells_cube_wall_and_table_apart():
    features, labels = touches(range(300))
    unseen, wanted = touches(range(1000, 1150))
    mean, scale = features.mean(axis=0), features.std(axis=0)
    features, unseen = (features - mean) / scale, (unseen - mean) / scale
    # Ridge regression to one-hot labels, in its dual form.
    gram = features @ features.T + 100.0 * np.eye(len(features))
    weights = features.T @ np.linalg.solve(gram, np.eye(3)[labels] - 1 / 3)
    accuracy = np.mean((unseen @ weights).argmax(axis=1) == wanted)
    assert accuracy >= 0.9


def test_pcm16_spans_the_range_and_clips():
    assert pcm16(np.array([-2.0, -1.0, 0.0, 0.5, 1.0, 2.0])).tolist() == [
        -32767,
        -32767,
        0,
        16384,
        32767,
        32767,
    ]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sample_rate": 16001}, r"sample_rate 16001 is not a multiple of control_hz 20.*16000"),
        ({"sample_rate": 4000}, "sample_rate is 4000.*at least 8000"),
        ({"physics_dt": 0.003}, r"physics_dt 0\.003.*0\.002"),
        ({"microphones": ("ceiling",)}, "ceiling.*gripper"),
        ({"microphones": ()}, "at least one"),
        ({"noise_level": -1.0}, "noise_level is -1.0"),
    ],
)
def test_unusable_options_are_refused(changes, message):
    options = {"microphones": ("gripper",), "sample_rate": 16000, "control_hz": 20, "physics_dt": PHYSICS_DT}
    with pytest.raises(ValueError, match=message):
        ContactSound(PAIRS, **(options | changes))


def test_every_mode_of_a_material_has_a_frequency_a_decay_and_a_gain():
    for material in MATERIALS.values():
        assert len(material.frequencies) == len(material.decays) == len(material.gains) > 0
        assert min(*material.frequencies, *material.decays) > 0


def test_unknown_material_is_refused():
    with pytest.raises(ValueError, match=r"'jelly'.*cube"):
        ContactPair("gripper-jelly", ("gripper", "jelly"), ("gripper", "jelly"))


def test_wrong_or_diverged_forces_are_refused():
    sound = make_sound()
    with pytest.raises(ValueError, match=r"shape \(25, 2\); wanted \(25, 5\)"):
        sound.step(np.zeros((25, 2)), np.zeros(25))
    with pytest.raises(ValueError, match="not finite"):
        sound.step(np.full((25, 5), np.nan), np.zeros(25))
