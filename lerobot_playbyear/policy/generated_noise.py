"""The noise of rooms with people in them, generated: voices, blows, clatter, music, footsteps and tools, and rooms around them.

Each training update makes clips of some kinds and a few rooms; its items hear them from different moments on. Everything is
chosen to be various, not to be true, except where a source is named. What is generated lasts as long as an item, goes round and
round in it, and reaches as high as the policy hears: `n_bins` frequencies, multiples of 1 / `seconds`.

In comments: C clips, O things that sound, E events of each, M modes of each, n samples of a clip (2 n_bins), F short frames.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

_THINGS, _MODES, _EVENTS = 4, 8, 24
_RING_S = 0.6  # longest that a blow is heard
_LN_60_DB = math.log(1000.0)

_FRAME, _STEP = 256, 64  # samples
_EDGE_S = 0.02  # in which a clip that does not go round by itself fades in and out
_FORMANTS = ((250.0, 900.0), (800.0, 2500.0), (2200.0, 3400.0))
"""Ranges of the first three formants [Hz] (Peterson and Barney, "Control methods used in a study of the vowels", 1952)."""

N_STRUCK = 2  # of all kinds that are struck, at a time: each takes 2 % of an update's time
_ROOMS = 4
_LATEST_S = 0.01  # by which sound reaches one microphone later than another: 3.4 m
_REFLECTIONS = 10
_EARLY_S = (0.002, 0.06)
_REVERBERATION_S = (0.1, 1.2)  # decay by 60 dB
_DIRECT_DB = (-10.0, 15.0)  # of what comes straight, relative to all that is reflected


class Draw:
    """Random numbers on a device, evenly from low to high, or evenly in their logarithm."""

    def __init__(self, device: torch.device):
        self.device = device

    def even(self, low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, device=self.device)

    def log(self, low: float, high: float, *shape: int) -> Tensor:
        return low * (high / low) ** torch.rand(shape, device=self.device)

    def often(self, share: float | Tensor, *shape: int) -> Tensor:
        """1 in this share of the cases, else 0."""
        return (torch.rand(shape, device=self.device) < share).float()

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, device=self.device)


def generated_noise(seconds: float, n_bins: int, device: torch.device) -> Tensor:
    """Clips of some kinds, all equally loud.

    Returns:
        (C, n_bins) complex, without the constant part: first `N_STRUCK` of different kinds in `SCORES`, then one of each in
        `STREAMS`. As `torch.fft.irfft(..., norm="forward")` makes waves of them their root mean square is 1.
    """
    draw, n, rate = Draw(device), 2 * n_bins, 2 * n_bins / seconds
    scores = [make(draw, seconds, 0.45 * rate) for make in SCORES.values()]
    chosen = torch.randperm(len(scores), device=device)[:N_STRUCK]
    struck = strike(draw, Score(*(torch.stack(each)[chosen] for each in zip(*scores, strict=True))), rate, n)
    waves = torch.stack([make(draw, rate, max(n, _FRAME))[:n] for make in STREAMS.values()])
    spectra = torch.cat([struck, torch.fft.rfft(faded(waves, rate))])[:, 1:]  # (C, n_bins)
    power = 2 * torch.view_as_real(spectra).square().sum(dim=(1, 2))
    return spectra * power.clamp(min=1e-20).rsqrt().unsqueeze(1)


def faded(waves: Tensor, rate: float) -> Tensor:
    """(..., n) -> the same shape, from silence to silence: what goes round in an item must not click at its ends."""
    ramp = (torch.arange(waves.shape[-1], device=waves.device) / (_EDGE_S * rate)).clamp(max=1)
    return waves * ramp * ramp.flip(0)


def rooms(n_microphones: int, seconds: float, n_bins: int, device: torch.device) -> Tensor:
    """What some rooms make of a sound on its way to every microphone, each at another place in them.

    A microphone hears the sound itself, a little later than another one does, single early reflections, and noise that dies
    away. A room has one decay and one ratio of what is direct, microphones have delays and reflections of their own.

    Returns:
        (rooms, n_microphones, n_bins) complex; the mean of its squared magnitude over frequency is 1.
    """
    draw, rate, shape = Draw(device), 2 * n_bins / seconds, (_ROOMS, n_microphones)
    n = min(2 * n_bins, math.ceil(rate * (_LATEST_S + max(_REVERBERATION_S))))
    time = torch.arange(n, device=device) / rate
    decay = _LN_60_DB / draw.log(*_REVERBERATION_S, _ROOMS, 1, 1)  # [1/s]
    straight = draw.even(0, _LATEST_S, *shape, 1)
    after = draw.log(*_EARLY_S, *shape, _REFLECTIONS)
    tail = draw.normal(*shape, n) * torch.exp(-decay * time) * (time > straight + _EARLY_S[0])
    early = draw.normal(*shape, _REFLECTIONS) * torch.exp(-decay * after) * (0.2 * rate * after.square()).sqrt()
    reflected = tail.scatter_add(2, ((straight + after) * rate).long().clamp(max=n - 1), early)
    direct = 10 ** (draw.even(*_DIRECT_DB, _ROOMS, 1, 1) / 20) * reflected.square().sum(dim=2, keepdim=True).sqrt()
    response = reflected.scatter_add(2, (straight * rate).long().clamp(max=n - 1), direct)
    response = response * response.square().sum(dim=2, keepdim=True).rsqrt()
    return torch.fft.rfft(response, n=2 * n_bins)[..., 1:]


# What is struck


class Score(NamedTuple):
    """When things are struck, how hard, and how they ring.

    Attributes:
        time, force: Of every event, (O, E) [s], [1].
        pitch, decay, gain: Of every mode, (O, M) [Hz], [s to fall by 60 dB], [1].
        burst, burst_decay: Of the noise of a blow, (O,) [1], [s to fall by 60 dB].
        attack: (O,) [s]: a bow's or a voice's is slow.
    """

    time: Tensor
    force: Tensor
    pitch: Tensor
    decay: Tensor
    gain: Tensor
    burst: Tensor
    burst_decay: Tensor
    attack: Tensor


def strike(draw: Draw, score: Score, rate: float, n: int) -> Tensor:
    """The spectra of clips, (C, n / 2 + 1) complex, of scores with one more dimension: every thing rings at all its events."""
    n_ring = min(n, math.ceil(_RING_S * rate))
    time = torch.arange(n_ring, device=draw.device) / rate  # (ring,)
    phase = 2 * math.pi * (score.pitch.unsqueeze(3) * time + draw.even(0, 1, *score.pitch.shape, 1))
    ringing = torch.exp(-_LN_60_DB / score.decay.unsqueeze(3) * time) * phase.sin()  # (C, O, M, ring)
    ringing = (score.gain.unsqueeze(2) @ ringing).squeeze(2)  # (C, O, ring)
    noise = draw.normal(*ringing.shape) * torch.exp(-_LN_60_DB / score.burst_decay.unsqueeze(2) * time)
    ringing = (ringing + score.burst.unsqueeze(2) * noise) * (1 - torch.exp(-time / score.attack.unsqueeze(2)))
    ringing = ringing * (1 - time / time[-1])
    places = (score.time * rate).long() % n
    blows = torch.zeros(*places.shape[:2], n, device=draw.device).scatter_add(2, places, score.force)
    return (torch.fft.rfft(blows) * torch.fft.rfft(ringing, n=n)).sum(dim=1)


def _modes(draw: Draw, low: float, high: float, decay: tuple[float, float], nyquist: float) -> dict[str, Tensor]:
    """Of things as they lie about: modes anywhere, which die the sooner the higher they are; a soft or a hard blow."""
    pitch = draw.log(low, min(high, nyquist), _THINGS, _MODES)
    lasting = draw.log(*decay, _THINGS, 1) * (pitch / 1000.0) ** -0.5 * draw.log(0.6, 1.7, *pitch.shape)
    softness = draw.log(300.0, 10_000.0, _THINGS, 1)  # [Hz] above which a blow excites little
    gain = draw.normal(*pitch.shape) / (1 + (pitch / softness).square())
    return {"pitch": pitch, "decay": lasting, "gain": gain}


def _bouncing(draw: Draw, seconds: float, share: Tensor, n_bounces: int) -> dict[str, Tensor]:
    """Blows at any time, near and far, each with bounces that follow faster and faster."""
    blows = (_THINGS, _EVENTS // n_bounces, 1)
    bounce, gap = torch.arange(n_bounces, device=draw.device), draw.log(0.03, 0.3, *blows)
    left = draw.even(0.4, 0.9, *blows)  # of the speed, after a bounce
    time = draw.even(0, seconds, *blows) + gap * (1 - left**bounce) / (1 - left)
    force = draw.often(share, *blows) * draw.log(0.05, 1, *blows) * left**bounce * draw.log(0.6, 1.6, *time.shape)
    return {"time": time.flatten(1), "force": force.flatten(1)}


def _blows(draw: Draw, seconds: float, nyquist: float) -> Score:
    """Single blows on things of many materials: a door, a cup put down, a hammer, a drum."""
    share = draw.even(0, 1, 1, 1, 1) ** 2
    return Score(
        **_bouncing(draw, seconds, 0.04 + 0.5 * share, 1),
        **_modes(draw, 80.0, 5000.0, (0.02, 1.0), nyquist),
        burst=draw.log(0.05, 3.0, _THINGS),
        burst_decay=draw.log(0.005, 0.3, _THINGS),
        attack=draw.log(0.0001, 0.003, _THINGS),
    )


def _clatter(draw: Draw, seconds: float, nyquist: float) -> Score:
    """Small hard things that fall and bounce."""
    share = draw.even(0, 1, 1, 1, 1)
    return Score(
        **_bouncing(draw, seconds, 0.15 + 0.7 * share, 6),
        **_modes(draw, 300.0, 7000.0, (0.02, 0.5), nyquist),
        burst=draw.log(0.02, 1.0, _THINGS),
        burst_decay=draw.log(0.005, 0.05, _THINGS),
        attack=draw.log(0.0001, 0.001, _THINGS),
    )


def _music(draw: Draw, seconds: float, nyquist: float) -> Score:
    """Notes with harmonics on the beats, plucked or drawn out, and one thing that is a drum."""
    beat = draw.log(0.1, 0.5, 1, 1)
    time = beat * torch.randint(math.ceil(seconds / 0.1), (_THINGS, _EVENTS), device=draw.device)
    fifths, octaves = (torch.randint(many, (_THINGS, 1), device=draw.device) for many in (5, 3))
    note = 7 * fifths % 12 + 12 * octaves  # semitones above the root, of a pentatonic scale
    overtone = torch.arange(1, _MODES + 1, device=draw.device)
    pitch = draw.log(40.0, 300.0, 1, 1) * 2 ** (note / 12) * overtone
    gain = overtone ** draw.even(-2.0, -0.3, _THINGS, 1) * draw.log(0.3, 3.0, *pitch.shape) * (pitch < nyquist)
    is_drum = (torch.arange(_THINGS, device=draw.device) == 0).float()
    return Score(
        time % seconds,
        draw.often(draw.even(0.2, 0.9, _THINGS, 1), _THINGS, _EVENTS) * draw.log(0.3, 1, _THINGS, _EVENTS),
        pitch,
        draw.log(0.15, 3.0, _THINGS, 1) * overtone**-0.5,
        gain,
        is_drum * draw.log(0.3, 5.0, _THINGS),
        draw.log(0.02, 0.4, _THINGS),
        draw.log(0.001, 0.1, _THINGS) ** (1 + is_drum),
    )


def _footsteps(draw: Draw, seconds: float, nyquist: float) -> Score:
    """Somebody who walks by: heel and sole of each foot, dull and short, with the scrape of the sole."""
    pace = draw.even(0.3, 0.8, 1)
    part = torch.arange(_THINGS, device=draw.device).reshape(_THINGS, 1)
    side, sole = part % 2, part // 2
    step = torch.arange(_EVENTS, device=draw.device)
    time = pace * (2 * step + side) + sole * draw.even(0.04, 0.16, 1) + draw.even(0, 0.04, _EVENTS)
    nearest = draw.even(0, seconds, 1)
    near = 1 / (0.5 + (time - nearest).abs() / draw.log(0.3, 5.0, 1))
    return Score(
        time,
        (time < seconds) * near * draw.log(0.4, 1.0, *time.shape) * torch.where(sole > 0, 0.5, 1.0),
        **_modes(draw, 60.0, 1500.0, (0.01, 0.08), nyquist),
        burst=draw.log(0.1, 2.0, _THINGS),
        burst_decay=draw.log(0.01, 0.2, _THINGS),
        attack=draw.log(0.0003, 0.01, _THINGS),
    )


# What goes on


def _speech(draw: Draw, rate: float, n: int) -> Tensor:
    """Somebody who speaks, (n,): a gliding pitch through formants that move, hisses, bursts and pauses."""
    frames = (n - _FRAME) // _STEP + 1
    n_sounds = math.ceil(n / rate / 0.04)
    kind = torch.rand(n_sounds, device=draw.device)
    pause, voiced = (kind < 0.12).float(), (kind > 0.35).float()
    lasting = draw.log(0.04, 0.25, n_sounds) * (1 + 3 * pause * torch.rand_like(pause))
    size = draw.log(0.85, 1.35, 1)  # of man, woman or child
    formants = [size * draw.even(low, high, n_sounds) for low, high in _FORMANTS]
    hiss = draw.log(0.03, 0.4, 1) * draw.log(0.1, 1.0, n_sounds)
    loudness = (1 - pause) * torch.where(voiced > 0, draw.log(0.2, 1.0, n_sounds), hiss)
    glide = draw.log(80.0, 280.0, 1) * draw.log(0.75, 1.35, n_sounds)
    targets = torch.stack([*formants, draw.log(1200.0, 6000.0, n_sounds), loudness, voiced, glide])
    place = (torch.arange(frames, device=draw.device) * _STEP + _FRAME // 2) / rate
    controls = _moving(targets, lasting, place, 5)
    loud, voice = controls[4:6, :, None]  # (F, 1)
    per_sample = functional.interpolate(controls[None, 4:], size=n, mode="linear")[0]
    turns = torch.cumsum(per_sample[2] / rate, dim=0)
    pulses = (turns.floor().diff(prepend=turns[:1]) > 0).float() * (rate / per_sample[2]).sqrt()
    source = per_sample[1] * pulses + (1 - 0.9 * per_sample[1]) * draw.normal(n)
    frequency = torch.fft.rfftfreq(_FRAME, 1 / rate, device=draw.device)
    centre = controls[:4, :, None]  # (4, F, 1)
    width = torch.stack([draw.log(0.7 * hz, 1.6 * hz, 1, 1) for hz in (45.0, 60.0, 90.0, 800.0)])
    peaks = ((frequency - centre) / width).square().add_(1).reciprocal_().sqrt_()  # (4, F, bins)
    weight = torch.stack([draw.log(0.6 * share, 1.6 * share, 1, 1) for share in (1.0, 0.6, 0.4)])
    dull = (1 + frequency / draw.log(200.0, 1500.0, 1)).reciprocal()
    envelope = loud * (voice * dull * (weight * peaks[:3]).sum(dim=0) + (1 - voice) * peaks[3])
    return _filtered(source, envelope)


def _tool(draw: Draw, rate: float, n: int) -> Tensor:
    """A motor that runs up and down, or a ratchet, (n,): a pitch, noise and bursts of noise through resonances."""
    frames, n_runs = n // _STEP, math.ceil(n / rate / 0.1)
    is_on = draw.often(0.6, n_runs) * draw.log(0.2, 1.0, n_runs)
    pitch = draw.log(8.0, 500.0, 1) * draw.log(0.5, 2.0, n_runs)
    place = torch.arange(frames, device=draw.device) * _STEP / rate
    controls = _moving(torch.stack([is_on, pitch]), draw.log(0.1, 2.0, n_runs), place, 9)
    loud, pitch = functional.interpolate(controls[None], size=n, mode="linear")[0]
    turn = torch.cumsum(pitch / rate, dim=0) % 1
    noise = draw.normal(n)
    parts = torch.stack([2 * turn - 1, (2 * math.pi * turn).sin(), noise, noise * torch.exp(-turn * 15.0)])
    wave = loud * (draw.log(0.05, 1.0, 4) @ parts)
    frequency = torch.fft.rfftfreq(n, 1 / rate, device=draw.device)
    centre, sharpness = draw.log(100.0, 4000.0, 3, 1), draw.log(1.0, 20.0, 3, 1)
    peaks = (1 + (sharpness * (frequency / centre - 1)).square()).reciprocal().sum(dim=0)
    return torch.fft.irfft(torch.fft.rfft(wave) * (0.1 + peaks), n=n)


def _moving(targets: Tensor, lasting: Tensor, place: Tensor, smoothing: int) -> Tensor:
    """Targets (T, sounds) that last so long [s] each, at places in time (F,) [s], smoothed over frames: (T, F)."""
    index = torch.searchsorted(lasting.cumsum(0), place).clamp(max=len(lasting) - 1)
    return functional.avg_pool1d(targets[:, index], smoothing, 1, smoothing // 2, count_include_pad=False)


def _filtered(wave: Tensor, envelope: Tensor) -> Tensor:
    """(n,) through a filter that changes, (F, bins) magnitudes: short frames that overlap."""
    window = torch.hann_window(_FRAME, device=wave.device)
    frames = torch.fft.rfft(wave.unfold(0, _FRAME, _STEP) * window) * envelope  # (F, bins)
    steps = (torch.fft.irfft(frames, n=_FRAME) * window).unflatten(1, (-1, _STEP))  # (F, steps of a frame, step)
    last = steps.shape[1] - 1
    parts = [functional.pad(steps[:, i], (0, 0, i, last - i)) for i in range(last + 1)]
    covered = torch.stack(parts).sum(dim=0).flatten()
    return functional.pad(covered, (0, len(wave) - len(covered)))


SCORES: dict[str, Callable[[Draw, float, float], Score]] = {
    "blows": _blows, "clatter": _clatter, "music": _music, "footsteps": _footsteps,
}  # fmt: skip
STREAMS: dict[str, Callable[[Draw, float, int], Tensor]] = {"speech": _speech, "tool": _tool}
