"""A real PulseAudio server whose sound cards are FIFOs: microphones through PortAudio without a sound card.

    with started(bench=2) as server, Player(server.fifo("bench"), channels=2) as player:
        player.play(samples, at_s=time.perf_counter() + 0.5)
        ...  # PortAudioMicrophoneConfig(device="bench")

PortAudio reads ALSA's configuration once and sees no later change, so the server sets `ALSA_CONFIG_PATH` in this process and
makes PortAudio look again. Another process that is to hear needs the variables of `server.environment`; one that is to be heard
writes to `server.fifo(name)` at the pace of time, with a `Player` or by itself.
"""

import contextlib
import ctypes.util
import importlib.util
import os
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

RATE = 48000
_CHUNK_S = 0.002
_ALSA = "/usr/share/alsa/alsa.conf"


def why_not() -> str:
    """What is missing for a sound server, as a reason to skip a test; empty if nothing is."""
    for program in ("pulseaudio", "pactl", "parec"):
        if shutil.which(program) is None:
            return f"{program} is not installed (Debian: pulseaudio, pulseaudio-utils)"
    if not Path(_ALSA).is_file() or not list(Path("/usr/lib").glob("*/alsa-lib/libasound_module_pcm_pulse.so")):
        return "ALSA's plug-in for PulseAudio is not installed (Debian: libasound2-plugins)"
    if importlib.util.find_spec("sounddevice") is None:
        return "sounddevice is not installed (pip install sounddevice)"
    if ctypes.util.find_library("portaudio") is None:
        return "PortAudio is not installed (Debian: libportaudio2)"
    return ""


class SoundServer:
    """PulseAudio with sources that read FIFOs; PortAudio in this process sees these sources and no other card.

    Args:
        folder: For all that it writes; the paths of sockets are short, so it is not deep.
        sources: How many channels each has, by its name, which is its device's name as well.
        sample_rate: Of all [Hz].
    """

    def __init__(self, folder: Path, sources: Mapping[str, int], sample_rate: int = RATE) -> None:
        self._folder, self._sources, self._rate = folder, dict(sources), sample_rate
        self._socket = folder / "socket"
        self._modules: dict[str, str] = {}
        self._listeners: dict[str, subprocess.Popen] = {}
        self._process: subprocess.Popen | None = None
        self._before: dict[str, str | None] = {}
        cards = "".join(
            f'pcm.{name} {{ type pulse device "{name}" server "unix:{self._socket}" }}\n' for name in self._sources
        )
        (folder / "alsa.conf").write_text(f"<{_ALSA}>\n{cards}")
        self.environment = {
            "ALSA_CONFIG_PATH": str(folder / "alsa.conf"),
            "PULSE_COOKIE": str(folder / "cookie"),
            "PULSE_RUNTIME_PATH": str(folder / "run"),  # else a folder in the system's temporary one
            "PULSE_STATE_PATH": str(folder / "state"),
        }

    def __enter__(self) -> Self:
        self._before = {name: os.environ.get(name) for name in self.environment}
        os.environ.update(self.environment)
        self.start()
        look_again()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.kill()
        for name, value in self._before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        look_again()

    def fifo(self, name: str) -> Path:
        """Where the samples of a source are written: int16, channels interleaved, at the pace of time, without a gap."""
        return self._folder / f"{name}.fifo"

    def start(self) -> None:
        """Starts the server, or starts it again, with all sources."""
        command = [
            *("pulseaudio", "-n", "--daemonize=no", "--exit-idle-time=-1", "--use-pid-file=no", "--disable-shm=yes"),
            *("--realtime=no", "--high-priority=yes"),
            f"--load=module-native-protocol-unix auth-anonymous=1 socket={self._socket}",
        ]
        environment = {**os.environ, **self.environment, "HOME": str(self._folder)}
        with (self._folder / "server.log").open("w") as log:
            self._process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
        deadline = time.perf_counter() + 10
        while self._pactl("info", check=False) is None:
            if time.perf_counter() > deadline:
                raise RuntimeError((self._folder / "server.log").read_text())
            time.sleep(0.02)
        for name in self._sources:
            self.add(name)

    def kill(self) -> None:
        """As if it had crashed."""
        process, self._process = self._process, None
        self._modules = {}
        if process is not None:
            process.send_signal(signal.SIGKILL)
            process.wait()
        for name in list(self._listeners):
            self._stop_listening(name)

    def add(self, name: str) -> None:
        """Plugs a source in; it is one of those that were named at first."""
        self.fifo(name).unlink(missing_ok=True)  # a server that was killed leaves it
        what = (
            f"source_name={name} file={self.fifo(name)} format=s16le rate={self._rate} channels={self._sources[name]}"
        )
        loaded = self._pactl("load-module", "module-pipe-source", *what.split())
        assert loaded is not None
        self._modules[name] = loaded.strip()
        # A listener of its own: a source that nobody records would leave what is written in the FIFO, for the next one.
        command = ["parec", f"--server=unix:{self._socket}", f"--device={name}", "--raw", "--latency-msec=20"]
        environment, silent = {**os.environ, **self.environment}, subprocess.DEVNULL
        self._listeners[name] = subprocess.Popen(command, env=environment, stdout=silent, stderr=silent)

    def remove(self, name: str) -> None:
        """Pulls a source out."""
        self._pactl("unload-module", self._modules.pop(name))
        self._stop_listening(name)

    def _stop_listening(self, name: str) -> None:
        listener = self._listeners.pop(name)
        listener.kill()
        listener.wait()

    def _pactl(self, *arguments: str, check: bool = True) -> str | None:
        command = ["pactl", f"--server=unix:{self._socket}", *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=check)
        return done.stdout if done.returncode == 0 else None


@contextlib.contextmanager
def started(**sources: int) -> Iterator[SoundServer]:
    """A server in a folder of its own, with sources of so many channels."""
    with tempfile.TemporaryDirectory() as folder, SoundServer(Path(folder), sources) as server:
        yield server


def look_again() -> None:
    """Makes PortAudio in this process read ALSA's configuration again. No stream may be open."""
    from lerobot_playbyear.microphones.portaudio import sound_cards

    sound_cards(fresh=True)


class Player(threading.Thread):
    """Writes to a source's FIFO at the pace of time: quiet noise, and what is to be played.

    Args:
        fifo: Where to.
        channels: Of the source.
        sample_rate: Of the source [Hz].
        noise: Its standard deviation, of 32,768; 0: zeros, which no microphone in a room gives.
        chunk_s: How much is written at a time [s].
    """

    def __init__(
        self, fifo: Path, channels: int, sample_rate: int = RATE, noise: float = 5.0, chunk_s: float = _CHUNK_S
    ) -> None:
        super().__init__(name="player", daemon=True)
        self._fifo, self._channels, self._rate, self._noise = fifo, channels, sample_rate, noise
        self._chunk_s = chunk_s
        self._ended, self._lock = threading.Event(), threading.Lock()
        self._waiting: list[tuple[float, np.ndarray]] = []
        self._file: int | None = None
        self._node = 0

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._ended.set()
        self.join()

    def play(self, samples: np.ndarray, at_s: float) -> None:
        """Adds (n,) or (n, channels) int16 to what is written; its first sample is due at `at_s` [s of time.perf_counter]."""
        wide = samples[:, None] if samples.ndim == 1 else samples
        with self._lock:
            self._waiting.append((at_s, np.broadcast_to(wide, (len(wide), self._channels)).astype(np.int32)))

    def run(self) -> None:
        with contextlib.suppress(OSError):  # others than root may not
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), -10)
        rng, n_done, size, start = np.random.default_rng(0), 0, round(self._chunk_s * self._rate), time.perf_counter()
        while not self._ended.wait(max(start + (n_done + size) / self._rate - time.perf_counter(), 0)):
            chunk = np.round(rng.normal(0, self._noise, (size, self._channels))).astype(np.int32)
            with self._lock:
                for at_s, samples in self._waiting:
                    first = round((at_s - start) * self._rate) - n_done
                    span = samples[max(-first, 0) : max(size - first, 0)]
                    chunk[max(first, 0) : max(first, 0) + len(span)] += span
                end = start + n_done / self._rate
                self._waiting = [(at, samples) for at, samples in self._waiting if at + len(samples) / self._rate > end]
            self._write(np.clip(chunk, -32768, 32767).astype("<i2").tobytes())
            n_done += size
        if self._file is not None:
            os.close(self._file)

    def _write(self, data: bytes) -> None:
        with contextlib.suppress(FileNotFoundError):
            node = self._fifo.stat().st_ino
            if node != self._node:  # the source was plugged in again
                if self._file is not None:
                    os.close(self._file)
                self._file, self._node = os.open(self._fifo, os.O_RDWR | os.O_NONBLOCK), node
        if self._file is None:
            return
        try:
            os.write(self._file, data)
        except BlockingIOError:  # nobody reads: what is old is thrown away, as a card does
            with contextlib.suppress(BlockingIOError):
                while os.read(self._file, 1 << 16):
                    pass
