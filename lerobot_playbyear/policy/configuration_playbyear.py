"""Configuration of the policy `playbyear`: its options, the windows that follow from them, and what is refused."""

import math
import shlex
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import draccus
from draccus.utils import DecodingError
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, NormalizationMode
from lerobot.optim.optimizers import AdamConfig
from lerobot.utils.constants import OBS_STATE

from lerobot_playbyear.audio.microphone_pictures import audio_key_of, microphone_pictures
from lerobot_playbyear.compat import encode_choice
from lerobot_playbyear.datasets.features import AUDIO_PREFIX, MICROPHONE, samples_per_frame
from lerobot_playbyear.datasets.frame_rate import divides, frame_rate
from lerobot_playbyear.policy.optimization import DTYPES, PlaybyearSchedulerConfig, training_dtype

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDatasetMetadata

_SIZES: dict[str, float] = {
    "n_frame_stack": 100,
    "n_memory_steps": 10_000,
    "n_supervised_steps": 10_000,
    "n_frequency_bins": 100_000,
    "image_size": 4096,
    "vision_width": 512,
    "hidden_size": 8192,
    "embedding_size": 8192,
}
"""From 1 to this: beyond it a configuration is damaged, or asks for all memory."""

_AT_MOST = {"memory_readers": 8192, "audio_window_s": 60, "sample_rate": 1_000_000, "augmentation_scale": 0.9}
_MOST_NUMBERS = 2**16  # of a state
_USUAL_FPS = 20
_LARGEST = 1000  # frames per second, and range of actions
_SHORTEST_HOP_S = 0.0005  # s: from column to column of the spectrogram
_AT_LEAST_0 = (
    *("audio_envelope_gain", "memory_displacement_gain", "memory_readers", "low_dimensional_gain"),
    *("low_dimensional_noise", "low_dimensional_offset", "auxiliary_onset", "auxiliary_balance", "auxiliary_way"),
)


@PreTrainedConfig.register_subclass("playbyear")
@dataclass
class PlaybyearConfig(PreTrainedConfig):
    """The audio-visual LSTM of "Play it by Ear" (Du et al., RSS 2022). Defaults are the paper's unless noted.

    Every frame is encoded from the last `n_frame_stack` images of every camera, the last `audio_window_s` of every
    microphone and the low-dimensional observations; an LSTM over the last `n_memory_steps` encodings gives the action.

    Inputs:
        fps: Frames per second of the dataset and the control loop [Hz]. Window lengths in frames follow from it. None: the
            dataset's; with `lerobot-train` only if that is 20.
        sample_rate: Samples per second of every microphone [Hz]. None: the dataset's.
        use_vision, use_audio: Encode pictures, encode sound. Leaving an encoding out is equivalent to the paper's inputs of
            zeros.
        use_memory: Use memory. Otherwise one frame with one image is encoded (the paper's ablation).
        n_frame_stack: Images stacked channel-wise before the vision encoder.
        n_memory_steps: Number of encodings that the LSTM reads, H.
        audio_window_s: Sound in one encoding [s].
        segment_s, hop_s: Segment length and hop length of the spectrogram [s].
        n_frequency_bins: Number of frequency bins kept from the lowest up. A bin is 1 / segment_s wide.
        image_size: Height and width of the images for the vision encoder [pixels]. 84 trains about five times faster than 224.
        reference_microphone: Name of a microphone that stands in the room, away from the arm. Of the others everything is heard
            as average that is not 10 dB louder than there, each above its own mean. None: none.
        audio_steps: Names in LeRobot's ProcessorStepRegistry: processing steps for the sound before the network, in training
            and at rollout. A trained policy keeps its own (`extension.MicrophoneStep`).
        extension_options: Options of encoders and `audio_steps` of other packages, by their names, such as `{waveform_cnn:
            {channels: 32}}`. A trained policy keeps its own.

    Architecture:
        vision_encoder, audio_encoder: Names of registered encoders (`extension.register_vision_encoder`,
            `register_audio_encoder`).
        vision_width: Channels of the first stage of the ResNet-18. 64 is the standard; the embedding is 8 times as wide.
        audio_channels: Channels of the audio encoder's convolutions, all with kernel 7.
        hidden_size: Size of the two hidden layers in the fusion and in the head.
        embedding_size: Size of the fused encoding and of the LSTM, D.
        normalize_encodings: Scale every camera's and microphone's encoding to the same size before the fusion (layer norm
            without parameters). Off is the paper's plain concatenation.
        audio_envelope_gain: Factor on the loudness of each column of a microphone's spectrogram (the mean of its bins), which
            the fusion reads beside the convolutions. It is not normalised, so two microphones can be compared. 0: off (the
            paper).
        low_dimensional_gain: Factor on the normalised low-dimensional observations before the fusion. With 1, the paper's, the
            arm's seven numbers weigh little among hundreds of encodings, and training takes several times as long.
        memory_displacement_gain: Factor on the displacements that the LSTM reads: how far the low-dimensional observations of
            each remembered frame are from the newest ones, in normalised units. 0: off (the paper).
        memory_readers: Number of weighted means of these displacements that the head reads beside the LSTM's last output. Their
            weights over the remembered frames follow from what was seen and heard there. 0: none (the paper).
        action_range: Largest action, in normalised units. With 1, the paper's, and normalisation to [-1, 1] no action exceeds
            those of the demonstrations. 1.5 reaches a quarter of their range further at both ends.

    Training:
        n_supervised_steps: Windows that a training item supervises, K: those that end on its last K frames. They share the
            encodings of its K + H - 1 frames. The paper's is 1; more is cheaper per window.
        augmentation_*: Augmentation of images in training, one draw per item and camera. Crop: largest shift of a
            replicate-padded crop [pixels of the original]; brightness: relative; hue: share of the colour circle; degrees:
            rotation; translate: share of the size; scale: relative.
        audio_noise_db: Largest level of noise mixed into training sound, relative to each item's own noise floor [dB]. None: no
            noise (the paper). Each item draws a colour, a hum and a level, uniformly from 20 dB below the floor to this one. It
            decides how much noise the policy tolerates: 18 is 8 times the background's amplitude.
        audio_room_noise: Whether three quarters of the items also hear voices, blows, clatter, music, footsteps or a tool,
            generated, in a room, 6 dB fainter than `audio_noise_db` at most; and whether spectrograms of all items are those
            of other microphones, whose gain has a standard deviation of 4 dB over frequency.
        audio_noise_files: Folder of WAV or FLAC files. The same, with excerpts of these; with both options half and half. Only
            training reads it.
        low_dimensional_noise: Standard deviation of noise on the normalised low-dimensional observations in training, drawn for
            every frame. The paper has none. Without it a policy memorises a few dozen demonstrations.
        low_dimensional_offset: Standard deviation of a second error, which all frames of an item share. It hides where a
            demonstration was recorded and keeps displacements as they are. 0: none (the paper).
        spectrogram_momentum: Weight of the newest batch in the running statistics of the spectrogram.
        auxiliary_*: Weights of auxiliary losses in training (`auxiliary.py`). 0: none (the paper). They change nothing when the
            policy acts. onset: whether a sudden sound begins in the newest frame [cross entropy, nats]. balance: each
            microphone's share of the power at such an onset, which tells where it was [Kullback-Leibler divergence, nats]. way:
            how far the low-dimensional observations have moved since the memory's last onset, at most 1 [Huber loss, normalised
            units]. A deaf policy has none of them. A policy with one microphone has no balance.
        dtype: Format of training, by autocast: "float32", "bfloat16", "float16" (with loss scaling) or "auto", the device's
            fastest. A format that the device lacks becomes float32. None: as `use_amp` says, which on an NVIDIA GPU means
            "auto". Acting always uses float32.
        optimizer_*: Adam's learning rate and weight decay, and the largest norm of the gradient. 0, the paper's, clips nothing.
        scheduler_*: Linear warm-up over this share of the updates, then a cosine decay to this share of the rate. The paper's
            rate is constant (0 and 1). With the schedule thousands of updates suffice instead of a hundred thousand.
    """

    # Inputs
    fps: float | None = None
    sample_rate: int | None = None
    use_vision: bool = True
    use_audio: bool = True
    use_memory: bool = True
    n_frame_stack: int = 3
    n_memory_steps: int = 10
    audio_window_s: float = 2.0
    segment_s: float = 0.040
    hop_s: float = 0.035
    n_frequency_bins: int = 160
    image_size: int = 224
    reference_microphone: str | None = None
    audio_steps: tuple[str, ...] = ()
    extension_options: dict[str, dict[str, Any]] = field(default_factory=dict)
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MEAN_STD,
            "ENV": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MIN_MAX,
        }
    )

    # Architecture
    vision_encoder: str = "resnet18"
    audio_encoder: str = "spectrogram_cnn"
    vision_width: int = 64
    audio_channels: tuple[int, ...] = (64, 32, 16, 8)
    hidden_size: int = 1024
    embedding_size: int = 50
    normalize_encodings: bool = True
    low_dimensional_gain: float = 4.0
    audio_envelope_gain: float = 0.0
    memory_displacement_gain: float = 0.0
    memory_readers: int = 0
    action_range: float = 1.0

    # Training
    n_supervised_steps: int = 8
    augmentation_crop: float = 4.0
    augmentation_brightness: float = 0.05
    augmentation_hue: float = 0.05
    augmentation_degrees: float = 5.0
    augmentation_translate: float = 0.05
    augmentation_scale: float = 0.05
    audio_noise_db: float | None = None
    audio_room_noise: bool = False
    audio_noise_files: str | None = None
    low_dimensional_noise: float = 0.0
    low_dimensional_offset: float = 0.0
    spectrogram_momentum: float = 0.01
    auxiliary_onset: float = 0.0
    auxiliary_balance: float = 0.0
    auxiliary_way: float = 0.0
    dtype: str | None = None
    optimizer_lr: float = 1e-3
    optimizer_weight_decay: float = 0.0
    optimizer_grad_clip_norm: float = 1.0
    scheduler_warmup_share: float = 0.03
    scheduler_final_share: float = 0.01

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            self._check_options()
        except ValueError as error:  # of which draccus would print no word
            raise DecodingError((), str(error)) from error
        self.fps = self.fps and frame_rate(self.fps)  # an option or JSON may have 20.0
        self._asked_dtype = self.dtype
        self.dtype = training_dtype(self.dtype, self.use_amp, str(self.device))  # LeRobot reads this, and not use_amp

    # Features

    @property
    def audio_keys(self) -> list[str]:
        """One per microphone, sorted."""
        return sorted(key for key in self.input_features or {} if key.startswith(AUDIO_PREFIX))

    @property
    def reference_key(self) -> str | None:
        """Of the microphone that is heard to be taken out."""
        return None if self.reference_microphone is None else f"{AUDIO_PREFIX}{self.reference_microphone}"

    @property
    def heard_keys(self) -> list[str]:
        """Of the microphones that are encoded: all but the reference."""
        return [key for key in self.audio_keys if key != self.reference_key]

    @property
    def camera_keys(self) -> list[str]:
        """One per camera, sorted."""
        return sorted(self.image_features)

    @property
    def low_dimensional_keys(self) -> list[str]:
        """Everything else that is observed, the state first."""
        kinds = (FeatureType.STATE, FeatureType.ENV)
        keys = {key for key, feature in (self.input_features or {}).items() if feature.type in kinds}
        return sorted(keys - set(self.audio_keys), key=lambda key: (key != OBS_STATE, key))

    def feature_shape(self, key: str) -> tuple[int, ...]:
        """Shape of one frame of an observation."""
        return tuple((self.input_features or {})[key].shape)

    # Windows, in frames, samples and columns of the spectrogram

    @property
    def memory_steps(self) -> int:
        """Encodings that the LSTM reads: H, or 1 without memory."""
        return self.n_memory_steps if self.use_memory else 1

    @property
    def frame_stack(self) -> int:
        """Images per encoding, 1 without memory."""
        return self.n_frame_stack if self.use_memory else 1

    @property
    def control_hz(self) -> float:
        """Frames per second; 20 as long as nothing has said it."""
        return self.fps or _USUAL_FPS

    @property
    def audio_frames(self) -> int:
        """Frames whose sound one encoding hears."""
        return math.ceil(round(self.audio_window_s * self.control_hz, 6))

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

    # Training presets

    def get_optimizer_preset(self) -> AdamConfig:
        return AdamConfig(
            lr=self.optimizer_lr, weight_decay=self.optimizer_weight_decay, grad_clip_norm=self.optimizer_grad_clip_norm
        )

    def get_scheduler_preset(self) -> PlaybyearSchedulerConfig | None:
        if self.scheduler_warmup_share == 0 and self.scheduler_final_share == 1:
            return None  # a constant rate
        # LeRobot shrinks both numbers together when a run is shorter than the decay.
        steps = 10**6
        return PlaybyearSchedulerConfig(
            num_warmup_steps=max(1, round(self.scheduler_warmup_share * steps)),
            num_decay_steps=steps,
            peak_lr=self.optimizer_lr,
            decay_lr=self.scheduler_final_share * self.optimizer_lr,
        )

    # Refusals: of options, of features, of a dataset

    def _check_options(self) -> None:
        """Checks the numbers, and that they go together.

        Raises:
            ValueError: Names the option.
        """
        for name, most in _SIZES.items():
            if not 1 <= getattr(self, name) <= most:
                raise ValueError(f"--policy.{name} must be at least 1 and at most {most:,}, got {getattr(self, name)}.")
        for name, most in _AT_MOST.items():
            if not (getattr(self, name) or 0) <= most:
                raise ValueError(f"--policy.{name} must be at most {most:,}, got {getattr(self, name)}.")
        for name in _AT_LEAST_0:
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"--policy.{name} must be at least 0 (none) and finite, got {getattr(self, name)}.")
        for name in ("fps", "action_range"):
            if getattr(self, name) is not None and not 0 < getattr(self, name) <= _LARGEST:
                raise ValueError(f"--policy.{name} must be above 0 and at most {_LARGEST}, got {getattr(self, name)}.")
        if self.memory_displacement_gain and not self.low_dimensional_gain:
            raise ValueError(
                f"--policy.memory_displacement_gain={self.memory_displacement_gain} compares low-dimensional observations, and "
                "--policy.low_dimensional_gain is 0: give 4, its usual value."
            )
        if self.memory_readers and not self.memory_displacement_gain:
            raise ValueError(
                f"--policy.memory_readers={self.memory_readers} read displacements, and "
                "--policy.memory_displacement_gain is 0: give 10, its usual value."
            )
        for option in ("audio_noise_files", "audio_room_noise"):
            if getattr(self, option) not in (None, False) and self.audio_noise_db is None:
                raise ValueError(
                    f"--policy.{option}={getattr(self, option)} says nothing of how loud the noise may be: add "
                    "--policy.audio_noise_db=24 (dB above the recordings' own noise floor)."
                )
        if not 0 < self.segment_s <= self.audio_window_s or not self.hop_s >= _SHORTEST_HOP_S:
            raise ValueError(
                f"--policy.audio_window_s ({self.audio_window_s}) must hold at least one segment of "
                f"--policy.segment_s ({self.segment_s}), and --policy.hop_s ({self.hop_s}) be {_SHORTEST_HOP_S} or more."
            )
        if min(self.audio_channels, default=0) < 1:
            raise ValueError(
                f"--policy.audio_channels must be one or more numbers from 1 on, got {self.audio_channels}."
            )
        if not (self.use_vision or self.use_audio or self.low_dimensional_keys or not self.input_features):
            raise ValueError(
                "--policy.use_vision=false and --policy.use_audio=false leave no observation to learn from: drop one of them."
            )
        strays = self.extension_options.keys() - {self.vision_encoder, self.audio_encoder, *self.audio_steps}
        if strays:
            raise ValueError(
                f"--policy.extension_options names {', '.join(sorted(strays))}; of the policy's encoders and audio_steps there "
                f"are {', '.join([self.vision_encoder, self.audio_encoder, *self.audio_steps])}."
            )
        if self.dtype not in (None, *DTYPES):
            raise ValueError(f"--policy.dtype must be one of {', '.join(DTYPES)}, got {self.dtype!r}.")

    def validate_features(self) -> None:
        """Checks that the features are ones that the policy can use.

        Raises:
            ValueError: Names what is missing or does not fit, and what to do.
        """
        features = self.input_features or {}
        if self.action_feature is None:
            raise ValueError("The dataset has no 'action': a policy cannot be trained without.")
        if self.use_vision and not self.camera_keys:
            raise ValueError(f"No camera among the observations {sorted(features)}: give --policy.use_vision=false.")
        for key in self.low_dimensional_keys:
            if math.prod(self.feature_shape(key)) > _MOST_NUMBERS:
                raise ValueError(
                    f"'{key}' has shape {self.feature_shape(key)}; wanted at most {_MOST_NUMBERS} numbers."
                )
        if not self.use_audio:
            return
        if not self.audio_keys:
            raise ValueError(_no_microphone_in(features))
        names = [key.removeprefix(AUDIO_PREFIX) for key in self.audio_keys]
        if self.reference_key and (self.reference_microphone not in names or len(names) == 1):
            raise ValueError(
                f"--policy.reference_microphone={self.reference_microphone} must be one of two microphones or more; there are: "
                f"{', '.join(names)}. Name one that stands in the room, record with another one (in a simulation "
                '--env.microphones=\'["gripper","room"]\'), or leave the option out.'
            )
        if self.sample_rate is None:
            raise ValueError(f"The sample rate of {self.audio_keys} is not known: set --policy.sample_rate.")
        for key in self.audio_keys:
            _check_samples(key, int(features[key].shape[0]), self.sample_rate, self.control_hz)

    def set_dataset_feature_metadata(self, features: dict[str, Any]) -> None:
        """Takes the sample rate from the dataset's features, and leaves microphones' pictures out of the observations: a policy
        that sees them hears, also one that should be deaf. LeRobot calls it before it builds the policy.

        Raises:
            ValueError: There is no sound, or a microphone's rate or frame length is missing or differs from the
                configuration.
        """
        for key, feature in features.items():
            if MICROPHONE in (feature.get("info") or {}) and self.input_features:
                self.input_features.pop(key, None)
        if not self.use_audio:
            return
        microphones = {key: feature for key, feature in features.items() if key.startswith(AUDIO_PREFIX)}
        if not microphones:
            raise ValueError(_no_microphone_in(features))
        for key, feature in microphones.items():
            seen = (feature.get("info") or {}).get("sample_rate", self.sample_rate)
            if seen is None:
                raise ValueError(
                    f"{key} has no info.sample_rate in the dataset: give it with --policy.sample_rate, or write it into "
                    "the dataset's meta/info.json."
                )
            if self.sample_rate is not None and int(seen) != self.sample_rate:
                raise ValueError(
                    f"{key} was recorded at {seen} Hz, but the policy is configured for {self.sample_rate} Hz: train with "
                    f"playbyear-train, which resamples, or a new policy with --policy.sample_rate={seen}."
                )
            self.sample_rate = int(seen)
            _check_samples(key, int(feature["shape"][0]), self.sample_rate, self.control_hz)

    def check_frame_rate(self, meta: "LeRobotDatasetMetadata") -> None:
        """Takes a dataset's frame rate. Raises a ValueError if the policy has another one."""
        own, rate = self.control_hz, frame_rate(meta.fps)
        if rate != own:
            raise ValueError(
                f"The dataset '{meta.repo_id}' has {rate} frames per second, and the policy is configured for {own}: "
                f"give --policy.fps={rate}, or a dataset recorded at {own}."
            )
        self.fps = rate

    def check_dataset(self, meta: "LeRobotDatasetMetadata") -> None:
        """Checks a dataset's frame rate, and leaves its microphones' pictures out of the observations.

        Raises:
            ValueError: The frame rate is not the configured one, or the sound of a microphone is not attached: a policy would
                see it instead of hearing it.
        """
        self.check_frame_rate(meta)
        inputs = self.input_features or {}
        for key in [key for key in microphone_pictures(meta) if key in inputs]:
            if audio_key_of(key) not in meta.features:
                raise ValueError(
                    f"'{key}' is a microphone's picture, and its sound is not attached: playbyear-attach-audio "
                    f"--dataset.repo_id={meta.repo_id} --dataset.root={shlex.quote(str(meta.root))} (it writes "
                    f"{meta.repo_id}_with_sound, in {meta.root}_with_sound: train on that)"
                )
            del inputs[key]


@draccus.encode.register(PlaybyearConfig)
def _encode(config: PlaybyearConfig, declared_type: type | None = None) -> dict[str, Any]:
    """For a file: with the `dtype` that was asked for, since the next machine may have other formats."""
    return {**encode_choice(config, PreTrainedConfig), "dtype": config._asked_dtype}


def segment_and_hop(sample_rate: int, segment_s: float, hop_s: float) -> tuple[int, int]:
    """Samples of a spectrogram's segment and of a step.

    The step is rounded down, so that a window holds as many segments at every sample rate.
    """
    return round(segment_s * sample_rate), math.floor(hop_s * sample_rate + 1e-6)


def _no_microphone_in(features: Iterable[str]) -> str:
    return (
        f"No '{AUDIO_PREFIX}<microphone>' among the features {sorted(features)}: record with sound, attach it "
        "(playbyear-attach-audio, also where a microphone was recorded as a camera), or set --policy.use_audio=false to "
        "train a deaf policy."
    )


def _check_samples(key: str, samples: int, sample_rate: int, fps: float) -> None:
    if not divides(fps, sample_rate):
        raise ValueError(
            f"sample_rate {sample_rate} / fps {fps} is not an integer: {key} cannot hold whole frames. Set "
            "--policy.fps to the dataset's."
        )
    if samples != samples_per_frame(sample_rate, fps):
        wanted = frame_rate(sample_rate / samples)
        raise ValueError(
            f"{key} has {samples} samples per frame, which at {sample_rate} Hz means {wanted} frames per "
            f"second, but the policy is configured for fps={fps}: set --policy.fps={wanted}."
        )
