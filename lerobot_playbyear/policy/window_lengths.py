"""How long the windows of a policy are, in frames, samples and columns, as its options in seconds say."""

import math


def segment_and_hop(sample_rate: int, segment_s: float, hop_s: float) -> tuple[int, int]:
    """Samples of a spectrogram's segment and of a step.

    The step is rounded down, so that a window holds as many segments at every sample rate.
    """
    return round(segment_s * sample_rate), math.floor(hop_s * sample_rate + 1e-6)


class WindowLengths:
    """What a policy's configuration derives from its options; a base of `PlaybyearConfig`, which has the options."""

    fps: int
    sample_rate: int | None
    use_audio: bool
    use_memory: bool
    n_frame_stack: int
    n_memory_steps: int
    audio_window_s: float
    segment_s: float
    hop_s: float
    n_frequency_bins: int
    n_supervised_steps: int

    @property
    def memory_steps(self) -> int:
        """Encodings that the LSTM reads: H, or 1 without memory."""
        return self.n_memory_steps if self.use_memory else 1

    @property
    def frame_stack(self) -> int:
        """Images per encoding, 1 without memory."""
        return self.n_frame_stack if self.use_memory else 1

    @property
    def audio_frames(self) -> int:
        """Frames whose sound one encoding hears."""
        return math.ceil(round(self.audio_window_s * self.fps, 6))

    @property
    def n_run_frames(self) -> int:
        """Frames that a training item encodes, R = K + H - 1."""
        return self.n_supervised_steps + self.memory_steps - 1

    @property
    def n_image_frames(self) -> int:
        """Images that a training item needs."""
        return self.n_run_frames + self.frame_stack - 1

    @property
    def n_audio_frames(self) -> int:
        """Frames of sound that a training item needs."""
        return self.n_run_frames + self.audio_frames - 1

    @property
    def observation_delta_indices(self) -> list[int]:
        longest = max(self.n_image_frames, self.n_audio_frames if self.use_audio else 0)
        return list(range(1 - longest, 1))

    @property
    def action_delta_indices(self) -> list[int]:
        return list(range(1 - self.n_supervised_steps, 1))

    @property
    def reward_delta_indices(self) -> None:
        return None

    @property
    def window_samples(self) -> int:
        """Samples of one encoding's sound."""
        assert self.sample_rate is not None
        return round(self.audio_window_s * self.sample_rate)

    @property
    def n_segments(self) -> int:
        """Columns of the spectrogram of one encoding's sound."""
        assert self.sample_rate is not None
        segment, hop = segment_and_hop(self.sample_rate, self.segment_s, self.hop_s)
        return (self.window_samples - segment) // hop + 1
