"""The scene as people see it: the same motion as the policy's scene, in better clothes.

It is a second model that only shows. Physics, and what the policy's cameras see, know nothing of it.
"""

import mujoco
import numpy as np

from gym_playbyear.looks_finishes import add_finishes, finish_of
from gym_playbyear.looks_shapes import seen
from gym_playbyear.rendering import SceneRenderer, Window
from gym_playbyear.scene import PEOPLE_CAMERA, compose
from gym_playbyear.task import Prop, Task

_CAMERA_SHIFT = (-0.21, -0.33, 0.42)  # m, from where the plain view is taken: the arm is in the picture
_FIELD = 37.0  # degrees
_SHADOW_SIZE, _SHADOW_REACH = 1024, 2.0  # pixels of the map of shadows, and half the side of what it covers [m]
_FLOOR_HALF_SIZE = 4.0  # m
_SKY = (0.93, 0.95, 0.97), (0.66, 0.72, 0.79)


class PeopleView:
    """Pictures and a window for people; opened when they are first asked for.

    Args:
        task: The task.
        size: Height and width of the picture [pixels].
        hidden_object: As for `compose`.
    """

    def __init__(self, task: Task, size: int, hidden_object: bool):
        self._stage = Stage(task, size, hidden_object)
        self._size = size
        self._renderer: SceneRenderer | None = None
        self._window: Window | None = None

    def picture(self, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
        """The simulation's state as a picture (size, size, 3) uint8."""
        model, data = self._shown(model, data)
        if self._renderer is None:
            self._renderer = SceneRenderer(model, self._size, shadows=True)
        return self._renderer.render(data, PEOPLE_CAMERA.name)

    def show(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Shows the simulation's state in a window."""
        model, data = self._shown(model, data)
        if self._window is None:
            self._window = Window(model, data)
        self._window.update()

    def close(self) -> None:
        """Closes window and OpenGL."""
        for resource in (self._renderer, self._window):
            if resource is not None:
                resource.close()

    def _shown(self, model: mujoco.MjModel, data: mujoco.MjData) -> tuple[mujoco.MjModel, mujoco.MjData]:
        self._stage.follow(model, data)
        return self._stage.model, self._stage.data


class Stage:
    """A task's scene for people.

    Args:
        task: The task.
        size: Height and width of the picture [pixels].
        hidden_object: As for `compose`.

    Attributes:
        model, data: To draw from, after `follow`.
    """

    def __init__(self, task: Task, size: int, hidden_object: bool = True):
        spec = compose(task, size, hidden_object)
        dress(spec, task)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)

    def follow(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Puts everything where it is in the simulation."""
        self.model.body_pos[:], self.model.body_quat[:] = model.body_pos, model.body_quat
        self.data.qpos[:] = data.qpos
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)


def dress(spec: mujoco.MjSpec, task: Task) -> None:
    """Gives a composed scene surfaces, light, a floor, and the shapes that arm and props have for the eye.

    Args:
        spec: From `compose`; no body is added or moved.
        task: Whose scene it is. An arm with a method `dress(spec)` is asked to do that; a prop with `looks` likewise.
    """
    add_finishes(spec)
    for prop in (task.arena, *task.props):
        _finish(spec, prop)
    dress_arm = getattr(task.arm, "dress", None)
    if dress_arm is not None:
        dress_arm(spec)
    _light(spec)
    _surround(spec)


def _finish(spec: mujoco.MjSpec, prop: Prop) -> None:
    body = spec.body(prop.name)
    for geom in _geoms_of(body):
        geom.material = finish_of(prop.material)
    if prop.looks is not None:
        prop.looks(spec, body)


def _geoms_of(body: mujoco.MjsBody) -> list[mujoco.MjsGeom]:
    return list(body.find_all("geom"))


def _light(spec: mujoco.MjSpec) -> None:
    """One lamp whose shadows show how high things are, and a soft one from the other side."""
    for light in spec.lights:
        light.active = False
    spec.worldbody.add_light(
        pos=(-0.9, -1.0, 2.9), dir=(0.42, 0.46, -0.9), diffuse=(0.62, 0.60, 0.56), specular=(0.35,) * 3, castshadow=True,
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
    )  # fmt: skip
    spec.worldbody.add_light(
        pos=(1.5, -1.0, 2.0), dir=(-0.7, 0.4, -0.6), diffuse=(0.16, 0.17, 0.20), specular=(0.1,) * 3, castshadow=False,
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
    )  # fmt: skip
    visual = spec.visual
    visual.headlight.ambient, visual.headlight.diffuse = [0.38, 0.39, 0.41], [0.14, 0.14, 0.14]
    visual.quality.shadowsize = _SHADOW_SIZE
    visual.quality.numslices, visual.quality.numstacks = 24, 12
    visual.map.shadowclip = _SHADOW_REACH / spec.stat.extent


def _surround(spec: mujoco.MjSpec) -> None:
    """Floor and sky, and the place to look from."""
    half = (_FLOOR_HALF_SIZE, _FLOOR_HALF_SIZE, 0.05)
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    seen(spec.worldbody, type=plane, size=half, material="floor", rgba=(0.80, 0.82, 0.84, 1))
    sky = spec.textures[0]
    sky.rgb1, sky.rgb2 = (list(colour) for colour in _SKY)
    camera = spec.camera(PEOPLE_CAMERA.name)
    camera.pos, camera.fovy = np.asarray(camera.pos) + _CAMERA_SHIFT, _FIELD
