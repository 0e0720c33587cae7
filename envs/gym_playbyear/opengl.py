"""How pictures are drawn: MuJoCo loads the OpenGL library that `MUJOCO_GL` names while it is imported.

What goes wrong with that is said here, before anything else of this package is imported.
"""

import os


class GLUnavailableError(RuntimeError):
    """No OpenGL library could be loaded for rendering; the message says what works."""


def no_context(why: Exception) -> GLUnavailableError:
    """The error of off-screen rendering."""
    return GLUnavailableError(
        f"No OpenGL context could be made for rendering (MUJOCO_GL={os.environ.get('MUJOCO_GL', '')!r}): {why}. "
        "Set MUJOCO_GL=egl (Debian: apt-get install libegl1 libgl1-mesa-dri), osmesa (libosmesa6), or glfw (needs a display)."
    )


try:
    import mujoco  # noqa: F401
except (ModuleNotFoundError, MemoryError):
    raise
except Exception as error:  # a name that MuJoCo does not know, or whatever PyOpenGL raises for want of a library
    raise no_context(error) from error
