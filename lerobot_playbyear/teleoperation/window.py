"""The window in which a person sees what happens and presses keys.

It lives in a process of its own: it answers while the policy learns for a minute, and its OpenGL does not meet that of the
simulation. A thread sends it the newest of what the control loop wants to show, so that the loop never waits. That process
imports this module, which is why nothing of LeRobot is imported here.
"""

import contextlib
import copy
import dataclasses
import logging
import os
import signal
import threading
import time
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from PIL import Image

from lerobot_playbyear.teleoperation.panel import SCENE, SIZE, Control, Status, draw

NAMED_KEYS = ("space", "tab", "enter", "escape", "left", "right", "up", "down")
"""Keys that have no letter for a name, as the window names them."""

_START_TIMEOUT_S = 60.0
_WAITING_AFTER_S = 0.7  # without a frame the control loop is busy with something else
_LOOK_S = 1 / 60  # how often the window looks for something new to show


class WindowKeys:
    """Which keys a person holds, and which were pressed since the last look.

    The window's thread writes, and `look` makes a picture of it that holds until the next look: a key that was tapped
    between two looks counts as held once.

    Attributes:
        held: Keys that were held at the last look, or tapped before it.
        pressed: Keys that were pressed before the last look, in their order.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._held: set[str] = set()
        self._pressed_since: list[str] = []
        self.held: frozenset[str] = frozenset()
        self.pressed: tuple[str, ...] = ()

    def look(self) -> None:
        """Take in what happened since the last time."""
        with self._lock:
            self.pressed = tuple(self._pressed_since)
            self.held = frozenset(self._held | set(self._pressed_since))
            self._pressed_since.clear()

    def note(self, name: str, is_pressed: bool) -> None:
        """A key went down or up."""
        with self._lock:
            if is_pressed:
                self._held.add(name)
                self._pressed_since.append(name)
            else:
                self._held.discard(name)


class Window:
    """Opens a window.

    Args:
        title: Of the window.

    Attributes:
        keys: What a person presses in it.
        is_open: Whether nobody has closed it.

    Raises:
        ExpertError: There is no screen, or something is not installed.
    """

    def __init__(self, title: str) -> None:
        self.keys, self.is_open = WindowKeys(), False
        self._next: tuple[Status, np.ndarray | None] | None = None  # nobody has sent it yet
        self._changed = threading.Condition()
        processes = get_context("spawn")
        self._connection, theirs = processes.Pipe()
        self._process = processes.Process(target=show_window, args=(title, theirs), daemon=True)
        self._process.start()
        theirs.close()
        problem = "it did not answer"
        try:
            if self._connection.poll(_START_TIMEOUT_S):
                problem = self._connection.recv()
        except EOFError:
            problem = "its process ended"
        if problem:
            from lerobot_playbyear.episodes.experts import ExpertError

            self.close()
            raise ExpertError(
                f"No window can be opened (DISPLAY={os.environ.get('DISPLAY', '')!r}): {problem}. A person as expert needs "
                "a screen and OpenGL."
            )
        self.is_open = True
        for work in (self._listen, self._send):
            threading.Thread(target=work, daemon=True).start()

    def show(self, status: Status, picture: np.ndarray | None = None) -> None:
        """Shows this as soon as possible, unless something newer comes before; returns at once.

        Args:
            status: What to tell.
            picture: (H, W, 3) uint8; None: the last one stays.
        """
        with self._changed:
            if picture is None and self._next is not None:
                picture = self._next[1]
            self._next = copy.deepcopy(status), picture  # of the status as it is now, because it goes on changing
            self._changed.notify()

    def close(self) -> None:
        """Closes it; it may be closed already."""
        self.is_open = False
        self._process.terminate()
        self._process.join(timeout=5)
        self._process.kill()
        self._process.join()

    def _send(self) -> None:
        with contextlib.suppress(OSError):
            while self.is_open:
                with self._changed:
                    self._changed.wait_for(lambda: self._next, timeout=1)
                    newest, self._next = self._next, None
                if newest is not None:
                    self._connection.send(newest)

    def _listen(self) -> None:
        with contextlib.suppress(EOFError, OSError):
            while True:
                self.keys.note(*self._connection.recv())
        if self.is_open:
            logging.info("The window was closed.")
        self.is_open = False


# The window's process


def show_window(title: str, connection: Connection) -> None:
    """Opens a window, shows what comes, and tells what is pressed, until either side closes.

    Args:
        title: Of the window.
        connection: Statuses and pictures come through it. It sends why no window can be opened, or "", and then keys with
            whether they are down.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the control loop handles Ctrl-C and closes the window
    try:
        import glfw
        from OpenGL import GL

        glfw.ERROR_REPORTING = False  # type: ignore[assignment, unused-ignore]
        screen = Screen(glfw, GL, title)
    except ImportError as error:
        connection.send(f"{error}; pip install glfw PyOpenGL")
        return
    except Exception as error:  # whatever the screen or OpenGL may say belongs into the message
        connection.send(str(error) or type(error).__name__)
        return
    try:
        _run(glfw, screen, connection)
    except (EOFError, OSError):
        pass  # the control loop is gone
    finally:
        glfw.terminate()


def _run(glfw: Any, screen: "Screen", connection: Connection) -> None:
    named = {getattr(glfw, f"KEY_{name.upper()}"): name for name in NAMED_KEYS}

    def on_key(window: Any, key: int, scancode: int, action: int, modifiers: int) -> None:
        name = named.get(key) or (glfw.get_key_name(key, scancode) or "").lower()
        if name and action != glfw.REPEAT:
            connection.send((name, action == glfw.PRESS))

    glfw.set_key_callback(screen.window, on_key)
    glfw.set_window_refresh_callback(screen.window, lambda window: screen.redraw())
    status, arrived = Status(), time.monotonic()
    screen.show(draw(status))
    connection.send("")
    while not glfw.window_should_close(screen.window):
        if connection.poll():
            (status, picture), arrived = connection.recv(), time.monotonic()
            screen.show(draw(status), picture)
        elif status.control is not Control.WAITING and time.monotonic() - arrived > _WAITING_AFTER_S:
            status = dataclasses.replace(status, control=Control.WAITING)
            screen.show(draw(status))
        glfw.wait_events_timeout(_LOOK_S)


class Screen:
    """A window with a picture of `SIZE` as large as it can be, and the scene in it.

    Raises:
        RuntimeError: There is no screen, or no OpenGL.
    """

    def __init__(self, glfw: Any, gl: Any, title: str) -> None:
        self._glfw, self._gl = glfw, gl
        if not glfw.init():
            raise RuntimeError("GLFW found no screen")
        self.window = glfw.create_window(*SIZE, title, None, None)
        if not self.window:
            raise RuntimeError("GLFW could not make a window with OpenGL (Debian: libgl1, libgl1-mesa-dri)")
        glfw.make_context_current(self.window)
        glfw.swap_interval(0)
        gl.glPixelStorei(gl.GL_UNPACK_ALIGNMENT, 1)
        self._scene: Image.Image | None = None
        glfw.focus_window(self.window)

    def show(self, image: np.ndarray, scene: np.ndarray | None = None) -> None:
        """Show a picture of `SIZE` and a scene, (height, width, 3) uint8; None: the last scene stays."""
        left, top, *size = SCENE
        if scene is not None:
            self._scene = Image.fromarray(scene).resize(size, Image.Resampling.BILINEAR)
        self._image = Image.fromarray(image)
        if self._scene is not None:
            self._image.paste(self._scene, (left, top))
        self.redraw()

    def redraw(self) -> None:
        """Show the same again, such as after the window changed its size."""
        gl, glfw = self._gl, self._glfw
        width, height = glfw.get_framebuffer_size(self.window)
        scale = min(width / SIZE[0], height / SIZE[1])
        shown = (max(round(scale * SIZE[0]), 1), max(round(scale * SIZE[1]), 1))
        image = self._image.resize(shown, Image.Resampling.BILINEAR)
        rows_up = image.transpose(Image.Transpose.FLIP_TOP_BOTTOM)  # OpenGL begins below
        gl.glClear(gl.GL_COLOR_BUFFER_BIT)
        gl.glWindowPos2i((width - shown[0]) // 2, (height - shown[1]) // 2)
        gl.glDrawPixels(*shown, gl.GL_RGB, gl.GL_UNSIGNED_BYTE, rows_up.tobytes())
        glfw.swap_buffers(self.window)
