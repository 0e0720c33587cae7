"""The process that shows the window: reads what to show, writes what is pressed. `window.py` starts it."""

import dataclasses
import os
import signal
import sys
import threading
import time
from typing import IO, Any

import numpy as np

from lerobot_playbyear.teleoperation.panel import SCENE, SIZE, draw
from lerobot_playbyear.teleoperation.status import Control, Status
from lerobot_playbyear.teleoperation.wire import Newest, receive, send

_WAITING_AFTER_S = 0.7  # without a frame the control loop is busy with something else
_LOOK_S = 0.25  # how often that is looked at
PRINTLESS = ("space", "escape", "left", "right", "up", "down")  # keys that have no letter for a name


class Inbox(Newest):
    """What comes through a pipe, read by a thread."""

    def __init__(self, stream: IO[bytes], wake: Any) -> None:
        super().__init__()
        self._stream, self._wake = stream, wake
        self.is_closed = False
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        while (received := receive(self._stream)) is not None:
            self.put(*received)
            self._wake()
        self.is_closed = True
        self._wake()


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
        gl.glEnable(gl.GL_TEXTURE_2D)
        self._textures: dict[tuple[int, int, int, int], int] = {}
        glfw.focus_window(self.window)

    def show(self, image: np.ndarray, scene: np.ndarray | None = None) -> None:
        """Show a picture of `SIZE` and a scene, (height, width, 3) uint8; None: the last scene stays."""
        self._load((0, 0, *SIZE), image)
        if scene is not None:
            self._load(SCENE, scene)
        self.redraw()

    def redraw(self) -> None:
        """Show the same again, such as after the window changed its size."""
        gl, glfw = self._gl, self._glfw
        width, height = glfw.get_framebuffer_size(self.window)
        scale = min(width / SIZE[0], height / SIZE[1])
        shown = (round(scale * SIZE[0]), round(scale * SIZE[1]))
        gl.glClear(gl.GL_COLOR_BUFFER_BIT)
        gl.glViewport((width - shown[0]) // 2, (height - shown[1]) // 2, *shown)
        gl.glMatrixMode(gl.GL_PROJECTION)
        gl.glLoadIdentity()
        gl.glOrtho(0, SIZE[0], SIZE[1], 0, -1, 1)
        for place, texture in self._textures.items():
            self._draw(place, texture)
        glfw.swap_buffers(self.window)

    def _load(self, place: tuple[int, int, int, int], image: np.ndarray) -> None:
        gl = self._gl
        if place not in self._textures:
            self._textures[place] = gl.glGenTextures(1)
        gl.glBindTexture(gl.GL_TEXTURE_2D, self._textures[place])
        for name in (gl.GL_TEXTURE_MIN_FILTER, gl.GL_TEXTURE_MAG_FILTER):
            gl.glTexParameteri(gl.GL_TEXTURE_2D, name, gl.GL_LINEAR)
        for name in (gl.GL_TEXTURE_WRAP_S, gl.GL_TEXTURE_WRAP_T):
            gl.glTexParameteri(gl.GL_TEXTURE_2D, name, gl.GL_CLAMP_TO_EDGE)
        height, width = image.shape[:2]
        gl.glTexImage2D(gl.GL_TEXTURE_2D, 0, gl.GL_RGB, width, height, 0, gl.GL_RGB, gl.GL_UNSIGNED_BYTE, image)

    def _draw(self, place: tuple[int, int, int, int], texture: int) -> None:
        gl, (left, top, width, height) = self._gl, place
        gl.glBindTexture(gl.GL_TEXTURE_2D, texture)
        gl.glBegin(gl.GL_QUADS)
        for x, y in ((0, 0), (1, 0), (1, 1), (0, 1)):
            gl.glTexCoord2f(x, y)
            gl.glVertex2f(left + x * width, top + y * height)
        gl.glEnd()


def run(glfw: Any, screen: Screen, inbox: Inbox, out: IO[bytes]) -> None:
    """Show what comes and tell what is pressed, until either side closes."""
    printless = {getattr(glfw, f"KEY_{name.upper()}"): name for name in PRINTLESS}

    def on_key(window: Any, key: int, scancode: int, action: int, modifiers: int) -> None:
        name = printless.get(key) or (glfw.get_key_name(key, scancode) or "").lower()
        if name and action != glfw.REPEAT:
            send(out, {"key": name, "is_pressed": action == glfw.PRESS})

    glfw.set_key_callback(screen.window, on_key)
    glfw.set_window_focus_callback(screen.window, lambda window, has: send(out, {"has_focus": bool(has)}))
    glfw.set_window_refresh_callback(screen.window, lambda window: screen.redraw())
    status, arrived = Status(), time.monotonic()
    screen.show(draw(status))
    send(out, {"has_focus": bool(glfw.get_window_attrib(screen.window, glfw.FOCUSED))})
    send(out, {"is_open": True})
    while not glfw.window_should_close(screen.window) and not inbox.is_closed:
        newest = inbox.take()
        if newest is not None:
            status, arrived = newest[0], time.monotonic()
            screen.show(draw(status), newest[1])
        elif status.control is not Control.WAITING and time.monotonic() - arrived > _WAITING_AFTER_S:
            status = dataclasses.replace(status, control=Control.WAITING)
            screen.show(draw(status))
        glfw.wait_events_timeout(_LOOK_S)


def main() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the control loop handles Ctrl-C and closes the window
    out = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # whatever a library prints is no message
    try:
        import glfw
        from OpenGL import GL
    except ImportError as error:
        send(out, {"problem": f"{error}; pip install glfw PyOpenGL"})
        return
    glfw.ERROR_REPORTING = False  # type: ignore[assignment, unused-ignore]
    try:
        screen = Screen(glfw, GL, sys.argv[1] if len(sys.argv) > 1 else "")
    except Exception as error:  # whatever the screen or OpenGL may say belongs into the message
        send(out, {"problem": str(error)})
        return
    try:
        run(glfw, screen, Inbox(sys.stdin.buffer, glfw.post_empty_event), out)
    except BrokenPipeError:
        pass
    finally:
        glfw.terminate()


if __name__ == "__main__":
    main()
