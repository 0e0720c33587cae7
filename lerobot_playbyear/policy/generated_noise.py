"""The noise of rooms with people in them, generated: voices, blows, clatter, music, footsteps and tools, and rooms around them.

Each training update makes clips of some kinds and a few rooms; its items hear them from different moments on. Everything is
chosen to be various, not to be true, except where a source is named. What is generated lasts as long as an item, goes round and
round in it, and reaches as high as the policy hears: `n_bins` frequencies, multiples of 1 / `seconds`.

In comments: C clips, O things that sound, E events of each, M modes of each, n samples of a clip (2 n_bins), F short frames.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional

STRUCK = ("blows", "clatter", "music", "footsteps")
"""Kinds of noise that are things which are struck."""

_RANGES = (
    ((80.0, 5000.0), (0.02, 1.0), (300.0, 10_000.0), (0.05, 3.0), (0.005, 0.3), (0.0001, 0.003)),
    ((300.0, 7000.0), (0.02, 0.5), (300.0, 10_000.0), (0.02, 1.0), (0.005, 0.05), (0.0001, 0.001)),
    ((40.0, 300.0), (0.15, 3.0), (300.0, 10_000.0), (0.02, 5.0), (0.02, 0.4), (0.001, 0.1)),
    ((60.0, 1500.0), (0.01, 0.08), (300.0, 10_000.0), (0.1, 2.0), (0.01, 0.2), (0.0003, 0.01)),
)
"""Of each: pitch of a mode, of music of the lowest note [Hz]; decay of a mode at 1 kHz [s to fall by 60 dB]; pitch above which
a blow excites little [Hz]; amplitude of a blow's noise beside the modes', and its decay [s]; time in which it sets in [s]."""

_N_STRUCK = 2  # of these kinds at a time: each takes 2 % of an update's time
_THINGS, _MODES, _EVENTS = 4, 8, 24
_RING_S = 0.6  # longest that a blow is heard
_BOUNCES = 6  # of a thing that falls
_BOUNCE_S, _LEFT = (0.03, 0.3), (0.4, 0.9)  # to the first bounce; of the speed, after each
_FAINTEST = 0.05  # of blows, far and near
_BEAT_S, _PACE_S = (0.1, 0.5), (0.3, 0.8)  # of music, of feet
_SOLE_S, _JITTER_S = (0.04, 0.16), (0.0, 0.04)  # from heel to sole
_LN_60_DB = math.log(1000.0)

_FRAME, _STEP = 256, 64  # samples
_EDGE_S = 0.02  # in which a clip that does not go round by itself fades in and out
_FORMANTS = ((250.0, 900.0), (800.0, 2500.0), (2200.0, 3400.0))
"""Ranges of the first three formants [Hz] (Peterson and Barney, "Control methods used in a study of the vowels", 1952)."""

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
        return torch.empty(shape, device=self.device).uniform_(low, high)

    def log(self, low: float, high: float, *shape: int) -> Tensor:
        return self.even(math.log(low), math.log(high), *shape).exp_()

    def whole(self, below: int, *shape: int) -> Tensor:
        return torch.randint(below, shape, device=self.device)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, device=self.device)


class GeneratedNoise(nn.Module):
    """Clips of noise of all kinds."""

    ranges: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("ranges", torch.tensor(_RANGES).log(), persistent=False)  # (kinds, parameters, 2)

    def forward(self, seconds: float, n_bins: int, n_items: int) -> Tensor:
        """A clip for every item, of any kind; items share a few.

        Returns:
            (n_items, n_bins) complex, without the constant part. As `torch.fft.irfft(..., norm="forward")` makes waves of them
            their root mean square is 1.
        """
        draw = Draw(self.ranges.device)
        chosen = torch.randperm(len(STRUCK), device=draw.device)[:_N_STRUCK]
        struck = self.struck(chosen, seconds, n_bins)
        clips = torch.cat([struck, *(self.stream(kind, seconds, n_bins).unsqueeze(0) for kind in STREAMS)])
        kinds = draw.whole(len(STRUCK) + len(STREAMS), n_items)  # all equally often
        return clips[torch.where(kinds < len(STRUCK), kinds % _N_STRUCK, kinds - len(STRUCK) + _N_STRUCK)]

    def struck(self, kinds: Tensor, seconds: float, n_bins: int) -> Tensor:
        """Clips of these kinds, indices of `STRUCK` (C,): (C, n_bins) complex."""
        draw, n, rate = Draw(self.ranges.device), 2 * n_bins, 2 * n_bins / seconds
        n_ring = min(n, math.ceil(_RING_S * rate))
        time = torch.arange(n_ring, device=draw.device) / rate  # (ring,)
        ringing = self._ringing(draw, kinds, time, 0.45 * rate)  # (C, O, ring)
        when, force = _events(draw, kinds, seconds)  # (C, O, E)
        silent = torch.zeros(*when.shape[:2], n, device=draw.device)
        blows = silent.scatter_add(2, (when * rate).long() % n, force)
        spectra = torch.fft.rfft(blows) * torch.fft.rfft(ringing * (1 - time / time[-1]), n=n)
        return _equally_loud(spectra.sum(dim=1)[:, 1:])

    def stream(self, kind: str, seconds: float, n_bins: int) -> Tensor:
        """A clip of one of `STREAMS`, (n_bins,) complex."""
        n, rate = 2 * n_bins, 2 * n_bins / seconds
        wave = STREAMS[kind](Draw(self.ranges.device), rate, max(n, _FRAME))[:n]
        return _equally_loud(torch.fft.rfft(faded(wave, rate))[1:])

    def _ringing(self, draw: Draw, kinds: Tensor, time: Tensor, highest_hz: float) -> Tensor:
        """What each thing sounds like when it is struck, (C, O, ring)."""
        low, high = self.ranges[kinds].unsqueeze(3).unbind(2)  # (C, parameters, 1)
        shape = (len(kinds), _THINGS, _MODES)
        drawn = torch.lerp(low, high, draw.even(0, 1, *low.shape[:2], _THINGS)).exp()  # (C, parameters, O)
        _, decay, softness, burst, burst_decay, attack = drawn.unsqueeze(3).unbind(1)  # (C, O, 1)
        anywhere = torch.lerp(low[:, :1], high[:, :1], draw.even(0, 1, *shape)).exp()
        fifths, octaves = draw.whole(5, *shape[:2], 1), draw.whole(3, *shape[:2], 1)
        note = 7 * fifths % 12 + 12 * octaves  # semitones, of a pentatonic scale
        overtone = torch.arange(1, _MODES + 1, device=draw.device)
        is_music = (kinds == STRUCK.index("music"))[:, None, None]
        pitch = torch.where(is_music, anywhere[:, :1, :1] * 2 ** (note / 12) * overtone, anywhere)  # (C, O, M)
        lasting = decay * (pitch / 1000.0) ** -0.5 * draw.log(0.6, 1.7, *shape)
        gain = draw.normal(*shape) / (1 + (pitch / softness).square()) * (pitch < highest_hz)
        phase = 2 * math.pi * (pitch.unsqueeze(3) * time + draw.even(0, 1, *shape, 1))
        modes = torch.exp(-_LN_60_DB / lasting.unsqueeze(3) * time) * phase.sin()  # (C, O, M, ring)
        noise = burst * draw.normal(*shape[:2], len(time)) * torch.exp(-_LN_60_DB / burst_decay * time)
        return ((gain.unsqueeze(2) @ modes).squeeze(2) + noise) * (1 - torch.exp(-time / attack))


def _events(draw: Draw, kinds: Tensor, seconds: float) -> tuple[Tensor, Tensor]:
    """When things are struck and how hard, both (C, O, E) [s], [1]."""
    shape = (len(kinds), _THINGS, _EVENTS)
    blows, clatter, music, steps = ((kinds == index)[:, None, None] for index in range(len(STRUCK)))
    event = torch.arange(_EVENTS, device=draw.device)
    # At any time, far and near; what falls bounces, faster and faster.
    bounce = event % torch.where(clatter, _BOUNCES, 1)  # (C, 1, E)
    of_blow = (event - bounce).expand(shape).unsqueeze(0).expand(3, -1, -1, -1)
    start, rarity, strength = draw.even(0, 1, 3, *shape).gather(3, of_blow)
    left, gap = draw.even(*_LEFT, *shape[:2], 1), draw.log(*_BOUNCE_S, *shape[:2], 1)
    share = torch.where(blows, 0.5, 1.0) * draw.even(0.2, 1, len(kinds), 1, 1) ** 2
    is_heard = rarity <= torch.maximum(share, rarity.amin(dim=(1, 2), keepdim=True))  # one at least
    when = seconds * start + gap * (1 - left**bounce) / (1 - left)
    force = is_heard * _FAINTEST**strength * left**bounce
    # On beats.
    beat = draw.log(*_BEAT_S, len(kinds), 1, 1) * draw.whole(math.ceil(seconds / _BEAT_S[0]), *shape)
    # Heel and sole of each foot, of somebody who walks by.
    part = torch.arange(_THINGS, device=draw.device).unsqueeze(1)
    pace, sole = draw.even(*_PACE_S, len(kinds), 1, 1), draw.even(*_SOLE_S, len(kinds), 1, 1)
    step = pace * (2 * event + part % 2) + sole * (part // 2) + draw.even(*_JITTER_S, len(kinds), 1, _EVENTS)
    away = (step - draw.even(0, seconds, len(kinds), 1, 1)).abs() / draw.log(0.3, 5.0, len(kinds), 1, 1)
    near = (step < seconds) * draw.log(0.4, 1.0, *shape) / (0.5 + away)
    return torch.where(steps, step, torch.where(music, beat, when)), torch.where(steps, near, force)


def _equally_loud(spectra: Tensor) -> Tensor:
    """(..., n_bins) complex -> the same shape, of waves whose root mean square is 1; what is silent stays so."""
    power = 2 * torch.view_as_real(spectra).square().sum(dim=(-1, -2))
    return spectra * power.clamp(min=1e-20).rsqrt().unsqueeze(-1)


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
    loudness = (1 - pause) * torch.where(voiced > 0, draw.log(0.3, 1.0, n_sounds), hiss)
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
    detuned = (frequency - centre) / width
    peaks = torch.complex(torch.ones_like(detuned), detuned).reciprocal()  # (4, F, bins), which ring after a pulse
    weight = torch.stack([draw.log(0.6 * share, 1.6 * share, 1, 1) for share in (1.0, 0.6, 0.4)])
    dull = (1 + frequency / draw.log(200.0, 1500.0, 1)).reciprocal()
    envelope = loud * (voice * dull * (weight * peaks[:3]).sum(dim=0) + (1 - voice) * peaks[3])
    return _filtered(source, envelope)


def _tool(draw: Draw, rate: float, n: int) -> Tensor:
    """A motor that runs up and down, or a ratchet, (n,): a pitch, noise and bursts of noise through resonances."""
    frames, n_runs = n // _STEP, math.ceil(n / rate / 0.1)
    chance = draw.even(0, 1, n_runs)
    is_on = (chance <= chance[:1].clamp(min=0.6)) * draw.log(0.2, 1.0, n_runs)
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
    """(n,) through a filter that changes, (F, bins): short frames that overlap."""
    window = torch.hann_window(_FRAME, device=wave.device)
    frames = torch.fft.rfft(wave.unfold(0, _FRAME, _STEP) * window) * envelope  # (F, bins)
    steps = (torch.fft.irfft(frames, n=_FRAME) * window).unflatten(1, (-1, _STEP))  # (F, steps of a frame, step)
    last = steps.shape[1] - 1
    parts = [functional.pad(steps[:, i], (0, 0, i, last - i)) for i in range(last + 1)]
    covered = torch.stack(parts).sum(dim=0).flatten()
    return functional.pad(covered, (0, len(wave) - len(covered)))


STREAMS: dict[str, Callable[[Draw, float, int], Tensor]] = {"speech": _speech, "tool": _tool}
"""Kinds of noise that go on."""
