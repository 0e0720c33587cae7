"""Pictures of the scene: the policy's cameras, and a second scene for people, off screen or in a window."""

import atexit
import copy
import os
import threading

import glfw
import mujoco
import mujoco.viewer
import numpy as np

from gym_playbyear.opengl import GLUnavailableError, no_context
from gym_playbyear.scene import PEOPLE_CAMERA, compose
from gym_playbyear.task import Task
from gym_playbyear.visuals import add_visuals


class SceneRenderer:
    """Renders one model's cameras off screen, without reflections, and by default without shadows: they cost time.

    Where Mesa draws without a GPU it does so in this thread alone (`LP_NUM_THREADS=0`), unless that variable says otherwise:
    waking other threads for a picture this small takes longer than drawing it, and ten times as long on a busy machine.
    """

    def __init__(self, model: mujoco.MjModel, size: int, shadows: bool = False):
        os.environ.setdefault("LP_NUM_THREADS", "0")
        try:
            self._renderer = mujoco.Renderer(model, height=size, width=size)
        except Exception as error:
            raise no_context(error) from error
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self._option = mujoco.MjvOption()
        self._option.sitegroup[:] = 0

    def render(self, data: mujoco.MjData, camera: str) -> np.ndarray:
        """The camera's picture, (size, size, 3) uint8."""
        self._renderer.update_scene(data, camera=camera, scene_option=self._option)
        return self._renderer.render()

    def close(self) -> None:
        self._renderer.close()


class Window:
    """A live view for a person (`render_mode="human"`); needs a display.

    It shows a copy of the simulation: neither what the viewer computes nor what the mouse pulls at changes the episode.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData):
        if not glfw.init():
            raise GLUnavailableError(
                f"No window can be opened (DISPLAY={os.environ.get('DISPLAY', '')!r}): render_mode='human' needs a display. "
                "Use render_mode='rgb_array' to get pictures without one."
            )
        self._model, self._data = model, data
        self._shown = copy.copy(data)
        others = set(threading.enumerate())
        self._viewer = mujoco.viewer.launch_passive(model, self._shown, show_left_ui=False, show_right_ui=False)
        self._threads = set(threading.enumerate()) - others
        # Before GLFW's own: a process that ends while the viewer's thread still draws dies of a segmentation fault.
        atexit.register(self.close)
        with self._viewer.lock():
            self._viewer.cam.type = mujoco.mjtCamera.mjCAMERA_FIXED
            self._viewer.cam.fixedcamid = model.camera("people").id

    def update(self) -> None:
        if self._viewer.is_running():
            with self._viewer.lock():
                mujoco.mj_copyData(self._shown, self._model, self._data)
            self._viewer.sync()

    def close(self) -> None:
        """Closes the window and waits until its thread has ended."""
        self._viewer.close()
        for thread in self._threads:
            thread.join(timeout=5)
        atexit.unregister(self.close)


class PeopleView:
    """A task's scene for people: the same motion, with shapes and light for the eye, as pictures and in a window. Physics, and
    what the policy's cameras see, know nothing of it.

    Args:
        task: The task.
        size: Height and width of the picture [pixels].
        hidden_object: As for `compose`.

    Attributes:
        model, data: What is drawn, after `follow`.
    """

    def __init__(self, task: Task, size: int, hidden_object: bool = True):
        spec = compose(task, size, hidden_object)
        add_visuals(spec, task)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._size = size
        self._renderer: SceneRenderer | None = None  # opened when they are first asked for
        self._window: Window | None = None
        self._drawn: tuple[bytes, np.ndarray] | None = None  # the last state and its picture

    def follow(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Puts everything where it is in the simulation."""
        self.model.body_pos[:], self.model.body_quat[:] = model.body_pos, model.body_quat
        self.data.qpos[:] = data.qpos
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def picture(self, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
        """The simulation's state as a picture (size, size, 3) uint8. What has not moved is not drawn again: an evaluation by
        LeRobot asks on when an episode is over."""
        state = data.qpos.tobytes() + model.body_pos.tobytes() + model.body_quat.tobytes()
        if self._drawn is None or self._drawn[0] != state:
            self.follow(model, data)
            if self._renderer is None:
                self._renderer = SceneRenderer(self.model, self._size, shadows=True)
            self._drawn = state, self._renderer.render(self.data, PEOPLE_CAMERA.name)
        return self._drawn[1].copy()

    def show(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Shows the simulation's state in a window."""
        self.follow(model, data)
        if self._window is None:
            self._window = Window(self.model, self.data)
        self._window.update()

    def close(self) -> None:
        """Closes window and OpenGL."""
        for resource in (self._renderer, self._window):
            if resource is not None:
                resource.close()
