"""Options of microphones, and the ones that are registered: `portaudio`, `file`, and those of other people's packages."""

import abc
import importlib
import logging
import math
from collections.abc import Hashable
from dataclasses import dataclass
from importlib import metadata

import draccus
from draccus.utils import DecodingError

from lerobot_playbyear.datasets.errors import PlaybyearError
from lerobot_playbyear.microphones.microphone import Microphone

PLUGIN_PREFIX = "lerobot_microphone_"
"""What the name of a distribution begins with that brings a type of microphone; its module has the same name."""


class MicrophoneOptionError(PlaybyearError, DecodingError):
    """An option of a microphone has no meaning. Being draccus' own as well, LeRobot's commands say it in one line."""

    def __init__(self, message: str) -> None:
        DecodingError.__init__(self, (), message)


@dataclass(kw_only=True)
class MicrophoneConfig(draccus.ChoiceRegistry, abc.ABC):
    """Options of a microphone. Subclasses register with `@MicrophoneConfig.register_subclass("type")`.

    Args:
        sample_rate: Samples per second [Hz], a multiple of the frames per second.
        channel: The card's channel, counted from 0.
        latency_s: How long after it was heard a sample arrives [s]; `playbyear-calibrate-latency` measures it.

    Raises:
        MicrophoneOptionError: An option is out of range.
    """

    sample_rate: int = 48000
    channel: int = 0
    latency_s: float = 0.0

    def __post_init__(self) -> None:
        if self.sample_rate <= 0:
            raise MicrophoneOptionError(
                f"sample_rate={self.sample_rate} of a microphone: give Hz above 0, such as 48000."
            )
        if not 0 <= self.channel < 256:
            raise MicrophoneOptionError(
                f"channel={self.channel} of a microphone: give the card's channel, counted from 0."
            )
        if not (math.isfinite(self.latency_s) and 0 <= self.latency_s <= 2):
            raise MicrophoneOptionError(f"latency_s={self.latency_s} of a microphone: give seconds from 0 to 2.")

    @property
    def type(self) -> str:
        return str(self.get_choice_name(self.__class__))

    @property
    @abc.abstractmethod
    def card(self) -> Hashable:
        """What tells cards apart: microphones with the same one share a stream and a clock, and all options but `channel`."""

    @abc.abstractmethod
    def make(self, channels: int) -> Microphone:
        """Makes the card, not connected yet, with at least as many channels."""


@MicrophoneConfig.register_subclass("portaudio")
@dataclass(kw_only=True)
class PortAudioMicrophoneConfig(MicrophoneConfig):
    """Any sound card of this machine, through PortAudio and the package `sounddevice`.

    Args:
        device: Its name, a part of it that no other has, or its number; `playbyear-find-microphones` lists them.
        card_channels: How many channels the card has; needed where it has more than two and a sound server (PulseAudio,
            PipeWire) is between, which mixes them where fewer are opened. None: what the card says.
        block_s: How often sound is fetched [s]; shorter costs more processor time.
        wait_s: How much sound the card keeps while this program is busy [s]; more is lost. It then comes in chunks of about a
            third of that. None: as short as the card can.
    """

    device: str | int = ""
    card_channels: int | None = None
    block_s: float = 0.005
    wait_s: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.001 <= self.block_s <= 0.5:
            raise MicrophoneOptionError(f"block_s={self.block_s} of a microphone: give seconds from 0.001 to 0.5.")
        if self.wait_s is not None and not 0 < self.wait_s <= 2:
            raise MicrophoneOptionError(f"wait_s={self.wait_s} of a microphone: give seconds above 0, up to 2.")
        if self.card_channels is not None and not self.channel < self.card_channels <= 256:
            raise MicrophoneOptionError(
                f"card_channels={self.card_channels} of a microphone: give more than its channel={self.channel}."
            )

    @property
    def card(self) -> Hashable:
        return "portaudio", str(self.device)

    def make(self, channels: int) -> Microphone:
        from lerobot_playbyear.microphones.portaudio import PortAudioMicrophone

        return PortAudioMicrophone(self, channels)


@MicrophoneConfig.register_subclass("file")
@dataclass(kw_only=True)
class FileMicrophoneConfig(MicrophoneConfig):
    """Plays a sound file in real time, for tests and demonstrations.

    Args:
        path: The file, as `playbyear-attach-audio` reads them; it has the sample rate that is asked for.
        repeat: Whether it begins again at its end; otherwise the microphone ends there.
        speed: How fast the card's clock is beside this machine's.
    """

    path: str = ""
    repeat: bool = True
    speed: float = 1.0

    @property
    def card(self) -> Hashable:
        return "file", self.path

    def make(self, channels: int) -> Microphone:
        from lerobot_playbyear.microphones.file import FileMicrophone

        return FileMicrophone(self, channels)


def make_microphone(config: MicrophoneConfig) -> Microphone:
    """A microphone with a card of its own, not connected yet; `read` gives all channels up to its own."""
    return config.make(config.channel + 1)


def register_microphone_plugins() -> None:
    """Imports installed distributions whose names begin with `lerobot_microphone_`, so that they register their types."""
    for distribution in metadata.distributions():
        name = distribution.metadata.get("Name") or ""
        if name.startswith(PLUGIN_PREFIX):
            try:
                importlib.import_module(name)
            except Exception:  # whatever is wrong with it, the others work
                logging.exception("Could not import the microphones of %s", name)
