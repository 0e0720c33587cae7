"""A microphone of your own: its sound is what a program prints, raw 16-bit samples, such as a sound server's or a network's.

    pip install ./examples/own_microphone
    lerobot-record --robot.cameras='{mic: {type: microphone, source: program, sample_rate: 48000,
        device: "parec --raw --format=s16le --rate={sample_rate} --channels={channels}"}}' ...

What you write is `_open` and `_close`; every chunk that comes goes to `_heard`, with the time at which its last sample came.
"""

import shlex
import subprocess
import threading
import time

import numpy as np

from lerobot_playbyear.microphones import Microphone, MicrophoneCameraConfig, MicrophoneError, register_source

_CHUNK_SECONDS = 0.01


class ProgramMicrophone(Microphone):
    """Listens to a program's standard output."""

    def __init__(self, command: str, sample_rate: int, channels: int) -> None:
        super().__init__(f"the program {command!r}", sample_rate, channels)
        self._command = shlex.split(command)

    def _open(self) -> None:
        try:
            self._program = subprocess.Popen(self._command, stdout=subprocess.PIPE)
        except OSError as error:
            raise MicrophoneError(f"{self.name} does not start: {error}. Give `device` a command that runs.") from error
        self._thread = threading.Thread(target=self._listen, name=self.name, daemon=True)
        self._thread.start()

    def _close(self) -> None:
        self._program.kill()
        self._thread.join()
        self._program.wait()

    def _listen(self) -> None:
        assert self._program.stdout is not None
        size = 2 * self.channels * round(_CHUNK_SECONDS * self.sample_rate)  # bytes
        while len(chunk := self._program.stdout.read(size)) == size:
            self._heard(np.frombuffer(chunk, np.int16).reshape(-1, self.channels), time.perf_counter())
        self._end(f"{self.name} ended")


@register_source("program")
def program_microphone(config: MicrophoneCameraConfig, channels: int) -> Microphone:
    """`--robot.cameras='{mic: {type: microphone, source: program, device: COMMAND}}'`"""
    command = str(config.device).format(sample_rate=config.sample_rate, channels=channels)
    return ProgramMicrophone(command, config.sample_rate, channels)
