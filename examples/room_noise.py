"""Makes recordings of noise, free of anybody's rights: a hum, and something like speech, music, clatter, hammering, typing
and a tool that starts and stops.

    python examples/room_noise.py outputs/noise --seconds=60
    playbyear-train --preset=cpu --policy.audio_noise_files=outputs/noise --dataset.repo_id=...
    lerobot-eval --env.type=playbyear --env.room_noise=outputs/noise/clatter.wav --env.room_noise_level=8 --policy.path=...

They stand in for recordings of your own room, which are better. Do not test a policy with the kind that it trained with:
`--kinds` chooses, and another `--seed` makes other recordings of the same kind.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy import signal
from scipy.io import wavfile

RATE = 48000
VOWELS = np.array([(730, 1090, 2440), (270, 2290, 3010), (300, 870, 2240), (530, 1840, 2480), (570, 840, 2410)])
"""First formants [Hz] of five vowels of a man (Peterson and Barney, "Control methods used in a study of the vowels", 1952)."""


def hum(rng: np.random.Generator, n: int) -> np.ndarray:
    """Mains hum with a dozen overtones that swell slowly, over a fan's low noise."""
    time, pitch = np.arange(n) / RATE, rng.choice([50.0, 60.0])
    wave = np.zeros(n)
    for overtone in range(1, 13):
        swell = 1 + 0.5 * np.sin(2 * np.pi * (rng.uniform(0.05, 0.4) * time + rng.uniform()))
        wave += rng.uniform(0.1, 1) / overtone * swell * np.sin(2 * np.pi * (pitch * overtone * time + rng.uniform()))
    fan = signal.sosfilt(signal.butter(1, 150, "lowpass", fs=RATE, output="sos"), rng.standard_normal(n))
    return wave + fan / fan.std()


def speech_like(rng: np.random.Generator, n: int) -> np.ndarray:
    """Syllables: pulses of a gliding pitch through the formants of vowels, hisses between them, and pauses."""
    wave, place = np.zeros(n), 0
    while place < n:
        length = int(rng.uniform(0.1, 0.3) * RATE)
        pitch = np.linspace(*rng.uniform(90, 240, 2), length)
        pulses = np.diff(np.floor(np.cumsum(pitch) / RATE), prepend=0)
        vowel = pulses + 0.02 * rng.standard_normal(length)
        for formant in rng.choice(VOWELS) * rng.uniform(0.9, 1.2):  # resonators in a row, each 90 Hz wide
            radius, angle = np.exp(-np.pi * 90 / RATE), 2 * np.pi * formant / RATE
            vowel = signal.lfilter([1 - radius], [1, -2 * radius * np.cos(angle), radius**2], vowel)
        syllable = np.hanning(length) * vowel / vowel.std()
        if rng.random() < 0.4:
            hiss = signal.sosfilt(
                signal.butter(2, (2500, 7000), "bandpass", fs=RATE, output="sos"), rng.standard_normal(length)
            )
            syllable = np.concatenate([0.5 * np.hanning(length) * hiss / hiss.std(), syllable])
        _add(wave, place, rng.uniform(0.4, 1) * syllable)
        place += len(syllable) + int((rng.uniform(0.3, 1) if rng.random() < 0.15 else 0) * RATE)
    return wave


def music_like(rng: np.random.Generator, n: int) -> np.ndarray:
    """Chords and a bass that ring, to a beat."""
    wave, beat = np.zeros(n), int(60 / rng.uniform(90, 140) * RATE)
    for index, place in enumerate(range(0, n, beat)):
        if index % 4 == 0:
            root = 110 * 2 ** (rng.integers(12) / 12)
        notes = [root / 2, *(root * 2 ** (step / 12) for step in rng.choice([(0, 4, 7), (0, 3, 7), (0, 5, 9)]))]
        for note in notes:
            time = np.arange(2 * beat) / RATE
            for overtone in range(1, 7):
                _add(
                    wave,
                    place,
                    np.exp(-time * (1.5 + overtone)) / overtone * np.sin(2 * np.pi * note * overtone * time),
                )
    return wave


def clatter(rng: np.random.Generator, n: int) -> np.ndarray:
    """Things of wood, plastic and metal that knock on each other and bounce, about four times a second."""
    wave = 1e-3 * rng.standard_normal(n)
    for place in np.sort(rng.integers(n, size=4 * n // RATE)):
        modes = rng.uniform(300, 7000, rng.integers(3, 7))
        decays, weights = rng.uniform(40, 300, len(modes)), rng.uniform(0.2, 1, len(modes))
        time = np.arange(int(0.2 * RATE)) / RATE
        knock = (weights[:, None] * np.exp(-decays[:, None] * time) * np.sin(2 * np.pi * modes[:, None] * time)).sum(
            axis=0
        )
        strength, gap = rng.uniform(0.1, 1), rng.uniform(0.04, 0.12)
        for bounce in range(rng.integers(1, 5)):
            _add(wave, int(place + bounce * gap * RATE), strength * 0.5**bounce * knock)
    return wave


def hammering(rng: np.random.Generator, n: int) -> np.ndarray:
    """Series of blows, each a burst of noise that a few resonances of what was struck draw out."""
    wave, place = 1e-3 * rng.standard_normal(n), 0
    while place < n:
        centres, every = rng.uniform(100, 4000, 4), rng.uniform(0.2, 0.6) * RATE
        for _ in range(rng.integers(2, 9)):
            burst = rng.standard_normal(int(0.15 * RATE)) * np.exp(-np.arange(int(0.15 * RATE)) / (0.004 * RATE))
            blow = 0.02 * burst
            for centre in centres:
                numerator, denominator = signal.iirpeak(centre, rng.uniform(5, 60), fs=RATE)
                blow = blow + signal.lfilter(numerator, denominator, burst)
            _add(wave, place, rng.uniform(0.3, 1) * blow / np.abs(blow).max())
            place += int(every * rng.uniform(0.9, 1.1))
        place += int(rng.uniform(0, 1.5) * RATE)
    return wave


def typing(rng: np.random.Generator, n: int) -> np.ndarray:
    """Words on a keyboard: a click when a key goes down and a fainter one when it comes up."""
    wave, place = 1e-3 * rng.standard_normal(n), 0
    while place < n:
        for _ in range(rng.integers(2, 12)):
            low = rng.uniform(500, 3000)
            band = signal.butter(2, (low, 2.5 * low), "bandpass", fs=RATE, output="sos")
            fall = np.exp(-np.arange(int(0.03 * RATE)) / (rng.uniform(0.001, 0.006) * RATE))
            for after, strength in ((0.0, rng.uniform(0.3, 1)), (rng.uniform(0.05, 0.12), rng.uniform(0.1, 0.4))):
                click = signal.sosfilt(band, rng.standard_normal(len(fall)) * fall)
                _add(wave, place + int(after * RATE), strength * click / np.abs(click).max())
            place += int(rng.uniform(0.08, 0.25) * RATE)
        place += int(rng.uniform(0.2, 1.5) * RATE)
    return wave


def tool(rng: np.random.Generator, n: int) -> np.ndarray:
    """A motor that runs up, whines and hisses for a while, and stops at once or slowly."""
    wave, place = 1e-3 * rng.standard_normal(n), 0
    while place < n:
        length = int(rng.uniform(0.2, 2.5) * RATE)
        pitch = rng.uniform(80, 600) * (1 - np.exp(-np.arange(length) / (rng.uniform(0.02, 0.3) * RATE)))
        whine = signal.sawtooth(2 * np.pi * np.cumsum(pitch) / RATE) + rng.uniform(0.1, 1) * rng.standard_normal(length)
        smooth = signal.sosfilt(signal.butter(2, rng.uniform(1000, 8000), fs=RATE, output="sos"), whine)
        stop = np.clip((length - np.arange(length)) / (rng.uniform(0.005, 0.2) * RATE), 0, 1)
        _add(wave, place, rng.uniform(0.3, 1) * stop * smooth)
        place += length + int(rng.uniform(0.1, 1.5) * RATE)
    return wave


KINDS: dict[str, Callable[[np.random.Generator, int], np.ndarray]] = {
    "hum": hum, "speech_like": speech_like, "music_like": music_like, "clatter": clatter, "hammering": hammering,
    "typing": typing, "tool": tool,
}  # fmt: skip


def write(folder: Path, kinds: list[str], seconds: float, seed: int) -> list[Path]:
    """Writes one WAV file of each kind, 16 bits at 48 kHz, and returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for kind in kinds:
        rng = np.random.default_rng([seed, *kind.encode()])
        wave = KINDS[kind](rng, int(seconds * RATE))
        paths.append(folder / f"{kind}.wav")
        wavfile.write(paths[-1], RATE, (32000 * wave / np.abs(wave).max()).astype(np.int16))
    return paths


def _add(wave: np.ndarray, place: int, sound: np.ndarray) -> None:
    """Adds a sound from a place on, as far as there is room."""
    part = wave[place : place + len(sound)]
    part += sound[: len(part)]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    for path in write(options.folder, options.kinds, options.seconds, options.seed):
        print(path)
