"""What a task is made of: parts that attach to one scene, and what is particular to it in a few functions."""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any

import mujoco
import numpy as np

from gym_playbyear.panda import Panda, SensorNoise
from gym_playbyear.terminations import EarlyAction, Success, Termination

PHYSICS_DT = 0.002  # s


def unknown_name(where: str, name: Any, known: Iterable[str]) -> ValueError:
    """The error for a name that nothing has, with the one that was probably meant."""
    names = sorted(known)
    near = get_close_matches(str(name), names, 1)
    meant = f"did you mean {near[0]!r}? " if near else ""
    return ValueError(f"{where}={name!r} is not known: {meant}There is {', '.join(names) or 'none'}.")


@dataclass(frozen=True)
class Prop:
    """A thing in the scene.

    Attributes:
        name: Of its outermost body. Contacts (`gripper-can`) and `env.position("can")` go by it.
        spec: That body as MJCF, `<body name=...>...</body>` or a whole `<mujoco>`, or as an `MjSpec` (kept as MJCF, so that
            tasks can be copied). Angles are in radians unless the `<mujoco>` says otherwise. Geoms that leave `contype` and
            `conaffinity` alone touch what a thing of this kind touches; zero for both means that one only sees them.
        material: Name in `sound.materials.ALL_MATERIALS`. None: its contacts make no sound and are not measured.
        loudness: Factor on its own share of a contact's sound.
        loose: It moves freely, by a free joint that has the prop's name, and may touch whatever is there.
        hidden: What no camera sees and hearing has to find. With `hidden_object=False` the hand passes through it.
        inside: Name of the prop that it is shut in: it touches nothing but that and what else is in there.
        jingles: It has parts, bodies within that one, which are heard when they knock against each other.
        bends: Joints within it whose motion crackles, each with a factor from its speed to that of bending in rad/s.
        visuals: `visuals(spec, body)` gives its body, in the scene that only people see, shapes for the eye
            (`gym_playbyear.visuals`). None: people see its geoms.
    """

    name: str
    spec: str | mujoco.MjSpec
    material: str | None = None
    loudness: float = 1.0
    loose: bool = False
    hidden: bool = False
    inside: str | None = None
    jingles: bool = False
    bends: tuple[tuple[str, float], ...] = ()
    visuals: Callable[[mujoco.MjSpec, mujoco.MjsBody], None] | None = None

    def __post_init__(self) -> None:
        if isinstance(self.spec, mujoco.MjSpec):
            object.__setattr__(self, "spec", self.spec.to_xml())


@dataclass(frozen=True)
class Camera:
    """A camera that the policy sees through, as `pixels.<name>`.

    Attributes:
        name: What it is called.
        attributes: The rest of MuJoCo's `<camera>`, such as `pos="0.5 0 1.35" euler="0 0.6 1.57" fovy="45"`.
    """

    name: str
    attributes: str


@dataclass(frozen=True)
class Task:
    """A task, complete. `TaskEnv` plays it; a function that returns one may take options of its own (`contents="bottle"`).

    `env` stands for the environment: see `TaskEnv` for what functions and scripts may ask it.

    Attributes:
        name: With its version, such as `OccludedGrasp-v1`; observed as `env.task`.
        description: One sentence of what to do, as LeRobot passes it to policies.
        arm: The arm.
        arena: What all stands on; a prop that is not loose.
        props: What else is there. Which contacts are measured and heard follows from arena and props.
        initialize_episode: `initialize_episode(env, options)` draws places from `env.np_random`, sets them with `env.set_pose`,
            and returns what the camera shows of the episode, in numbers by name (`hidden_range`, ...): `env.shown`. What only
            sound tells it puts into `env.secrets`, and what props are made of this time into `env.materials`.
        reset_options: Names of what `initialize_episode` understands in `options`; others that are spelt nearly like them are
            refused.
        success: When the task is solved.
        terminations: By what an attempt fails, in order; their names appear in `info["end"]`.
        expert: `expert(env)` makes the scripted expert: `act()` gives the next action.
        horizon: Steps after which an attempt is cut off.
        early_action: What tells whether an attempt acted before it had heard anything (`info["acted_early"]`).
        gate: `gate(env, expert)` makes the intervention gate; None: there is none.
        blind: Scripts without any sense of contact, by name; each is `script(env)`.
        deaf: Scripts that feel with the arm and do not hear, by name; each is `script(facts, rng)`, see
            `gym_playbyear.check`. Tasks whose camera shows a `hidden_range` have ours without naming any.
        sees: `sees(env)`: what the camera shows of the moment, in numbers by name, in addition to `env.shown`.
        twins: Options of two worlds in which nothing differs but what only sound tells: the task's own, or of `TaskEnv`.
        control_hz, sample_rate: Steps, and samples of a microphone, per second.
        physics_dt: Duration of a physics step [s].
        microphones: Those that are on unless the environment is asked for others.
        cameras: What the policy sees through; a square picture each.
        start, start_spread: Where the tool is before an episode [m, world], and how far it may be off along each axis.
        sensors: What is wrong with what the arm measures of itself.
        force_proxy_of: Prop whose contact force stands in for sound with `sound="contact_force"`.
        numbers: The task's own numbers, for its functions and scripts.
        limits: What the task promises of those who play it, where that differs from `check.Limits`.

    Raises:
        ValueError: A part names something that is not there, or is of another class than it must be; the message names it.
    """

    name: str
    description: str
    arm: Panda
    arena: Prop
    props: tuple[Prop, ...]
    initialize_episode: Callable[[Any, dict[str, Any]], dict[str, Any]]
    success: Success
    expert: Callable[[Any], Any]
    horizon: int
    reset_options: tuple[str, ...] = ()
    terminations: tuple[Termination, ...] = ()
    early_action: EarlyAction = field(default_factory=EarlyAction)
    gate: Callable[[Any, Any], Any] | None = None
    blind: Mapping[str, Callable[[Any], Any]] = field(default_factory=dict)
    deaf: Mapping[str, Callable[[Any, np.random.Generator], Any]] = field(default_factory=dict)
    sees: Callable[[Any], dict[str, Any]] | None = None
    twins: tuple[Mapping[str, Any], Mapping[str, Any]] = ({}, {"hidden_object": False})
    control_hz: int = 20
    sample_rate: int = 16000
    physics_dt: float = PHYSICS_DT
    microphones: tuple[str, ...] = ("gripper",)
    cameras: tuple[Camera, ...] = ()
    start: tuple[float, float, float] = (-0.12, 0.0, 0.98)
    start_spread: float = 0.02
    sensors: SensorNoise = field(default_factory=SensorNoise)
    force_proxy_of: str | None = None
    numbers: Any = None
    limits: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        steps = 1.0 / (self.control_hz * self.physics_dt)
        if round(steps) < 1 or abs(steps - round(steps)) > 1e-6 * steps:
            raise ValueError(
                f"{self.name}: physics_dt={self.physics_dt} s does not divide a control step of 1/{self.control_hz} s into "
                "whole physics steps: change one of the two, for example to 0.002 and 20."
            )
        self._check_names()
        if not isinstance(self.terminations, tuple | list):
            raise ValueError(
                f"{self.name}: terminations={self.terminations!r} is not a tuple: write (..., ), with a comma."
            )
        rules = [("success", self.success, Success), ("early_action", self.early_action, EarlyAction)]
        for where, rule, kind in [*rules, *(("terminations", rule, Termination) for rule in self.terminations)]:
            if not isinstance(rule, kind):
                a_rule = rule.__name__ if isinstance(rule, type) else kind.__name__
                raise ValueError(
                    f"{self.name}: {where} has {rule!r}, which is not an instance of "
                    f"gym_playbyear.terminations.{kind.__name__}: write {a_rule}(...)."
                )
            prop = getattr(rule, "prop", None) if type(rule).__module__ == kind.__module__ else None
            props = [part.name for part in (self.arena, *self.props)]
            if prop is not None and prop not in props:
                raise unknown_name(f"{self.name}: {type(rule).__name__}, prop", prop, props)
        self._check_collections()

    def _check_collections(self) -> None:
        """Raises ValueError for what should be a collection and is none, or not of the right things."""
        if isinstance(self.reset_options, str):
            raise ValueError(
                f"{self.name}: reset_options={self.reset_options!r} is not a tuple: write (..., ), with a comma."
            )
        for where, scripts in (("blind", self.blind), ("deaf", self.deaf)):
            if not isinstance(scripts, Mapping):
                raise ValueError(f'{self.name}: {where}={scripts!r} names no scripts: write {{"name": script}}.')
        twins = self.twins
        if not isinstance(twins, tuple | list) or len(twins) != 2 or not all(isinstance(w, Mapping) for w in twins):
            raise ValueError(
                f"{self.name}: twins={twins!r} are not two worlds: write the options of each, such as "
                '({"contents": "screws"}, {"contents": "peanuts"}).'
            )

    def _check_names(self) -> None:
        """Raises ValueError for a prop or a material that there is not."""
        from gym_playbyear.sound.materials import ALL_MATERIALS  # which itself needs `Task`

        parts = (self.arena, *self.props)
        props = [prop.name for prop in parts]
        named: list[tuple[str, str | None, Collection[str]]] = [("force_proxy_of", self.force_proxy_of, props)]
        for prop in parts:
            named.append((f"Prop {prop.name!r}, inside", prop.inside, props))
            named.append((f"Prop {prop.name!r}, material", prop.material, ALL_MATERIALS))
        for where, name, known in named:
            if name is not None and name not in known:
                raise unknown_name(f"{self.name}: {where}", name, known)
