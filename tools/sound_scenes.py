"""Small scenes in which one thing hits, slides on or squeezes another, and the sound of that.

They need neither arm nor task: a box is dropped on a table, pulled along it, or held between two fingers.
"""

from dataclasses import dataclass, field

import mujoco
import numpy as np
from mujoco import rollout

from gym_playbyear.contacts import ContactPair, ContactReader, Contacts, add_sensors
from gym_playbyear.sound import Bending, Synthesizer

CONTROL_HZ = 20
HALF = 0.02  # m, of the box
_BOX, _PLANE, _FREE = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtJoint.mjJNT_FREE
_SLIDE = mujoco.mjtJoint.mjJNT_SLIDE


@dataclass
class Scene:
    """A model with its sounding pairs.

    Attributes:
        model: Compiled, with sensors.
        pairs: What is heard.
        ears: Where the microphones are, (3,) each [m].
    """

    model: mujoco.MjModel
    pairs: list[ContactPair]
    ears: dict[str, np.ndarray] = field(default_factory=lambda: {"table": np.array([0.1, 0.0, 0.0])})

    def __post_init__(self) -> None:
        self.data = mujoco.MjData(self.model)
        self.reader = ContactReader(self.model, self.pairs)
        self.n_substeps = round(1 / CONTROL_HZ / self.model.opt.timestep)

    def contacts(self, seconds: float) -> list[Contacts]:
        """Lets the scene go on; one control step after the other."""
        full = mujoco.mjtState.mjSTATE_FULLPHYSICS
        state = np.empty(mujoco.mj_stateSize(self.model, full))
        steps = []
        for _ in range(round(seconds * CONTROL_HZ)):
            mujoco.mj_getState(self.model, self.data, state, full)
            controls = np.tile(self.data.ctrl, (self.n_substeps, 1))
            warm = self.data.qacc_warmstart[None].copy()
            sensors = rollout.rollout(self.model, self.data, state[None], controls[None], initial_warmstart=warm)[1]
            steps.append(self.reader.read(sensors[0]))
        return steps

    def synth(self, sample_rate: int = 16000, **options) -> Synthesizer:
        """A synthesiser for this scene; nothing is random and there is no background, unless `options` say so."""
        options = {"noise_level": 0.0, "randomise": False, **options}
        return Synthesizer(self.pairs, list(self.ears), sample_rate, CONTROL_HZ, self.model.opt.timestep, **options)


def box_on_table(
    materials: tuple[str, str] = ("cube", "table"), timestep: float = 0.002, softness: float = 0.005,
    speed: float = 0.0, mass: float = 0.128,
) -> Scene:  # fmt: skip
    """A loose box of 4 cm that lies on a table, or falls on it flat at `speed` [m/s]; `softness`: MuJoCo's, of contact [s]."""
    spec = _spec(timestep)
    _table(spec, softness)
    box = spec.worldbody.add_body(name="box", pos=[0, 0, HALF])
    box.add_joint(type=_FREE)
    box.add_geom(type=_BOX, size=[HALF] * 3, mass=mass, friction=[0.01, 0.005, 0.0001], solref=[softness, 1])
    scene = _scene(spec, [ContactPair(("box", "table"), materials)])
    scene.data.qpos[2] += 0.03 * speed if speed else -1e-4
    scene.data.qvel[2] = -speed
    scene.model.opt.gravity[2] *= not speed  # it arrives as fast as it left
    return scene


def box_pulled(
    speed: float, force: float, materials: tuple[str, str] = ("cube", "table"), timestep: float = 0.002
) -> Scene:
    """A box that is pressed on a table with `force` [N] and pulled along it at `speed` [m/s]."""
    spec = _spec(timestep)
    spec.option.gravity = [0, 0, 0]
    _table(spec, 0.005)
    box = spec.worldbody.add_body(name="box", pos=[0, 0, HALF])
    box.add_geom(type=_BOX, size=[HALF] * 3, density=2000, friction=[0.01, 0.005, 0.0001])
    for name, axis, drive in (("pull", [1, 0, 0], speed), ("press", [0, 0, 1], 0.0)):
        box.add_joint(name=name, type=_SLIDE, axis=axis)
        gain, bias = (1000.0, [0.0, 0.0, -1000.0]) if drive else (1.0, [0.0, 0.0, 0.0])
        spec.add_actuator(
            name=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=name, gainprm=[gain, *[0.0] * 9],
            biastype=mujoco.mjtBias.mjBIAS_AFFINE, biasprm=[*bias, *[0.0] * 7],
        )  # fmt: skip
    scene = _scene(spec, [ContactPair(("box", "table"), materials)])
    scene.data.ctrl[:] = (speed, -force)
    return scene


def two_fingers(
    materials: tuple[str, str] = ("gripper", "cube"), timestep: float = 0.002, box: bool = True, shift: float = 0.0
) -> Scene:
    """Two fingers 55 mm apart that close along y at 5 cm/s, and a box on a table between them, `shift` [m] off the middle."""
    spec = _spec(timestep)
    _table(spec, 0.005)
    for name, sign in (("left_finger", 1.0), ("right_finger", -1.0)):
        finger = spec.worldbody.add_body(name=name, pos=[0, sign * 0.005, 0.03])
        joint = finger.add_joint(name=name, type=_SLIDE, axis=[0, sign, 0], range=[0, 0.03], armature=0.1, damping=5)
        joint.limited, joint.solref_limit = mujoco.mjtLimited.mjLIMITED_TRUE, [0.005, 1]
        finger.add_geom(type=_BOX, size=[0.01, 0.005, 0.025], mass=0.015, contype=1, conaffinity=2, solref=[0.005, 1])
        spec.add_actuator(
            name=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=name, gainprm=[100.0, *[0.0] * 9],
            biastype=mujoco.mjtBias.mjBIAS_AFFINE, biasprm=[0.0, 0.0, -100.0, *[0.0] * 7], forcerange=[-20, 20],
            forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
        )  # fmt: skip
    pairs = [ContactPair(("left_finger", "right_finger"), (materials[0], materials[0]), stop="left_finger")]
    if box:
        body = spec.worldbody.add_body(name="box", pos=[0, shift, HALF])
        body.add_joint(type=_FREE)
        body.add_geom(type=_BOX, size=[HALF] * 3, density=2000, contype=2, conaffinity=3, solref=[0.005, 1])
        pairs += [ContactPair((f"{side}_finger", "box"), materials) for side in ("left", "right")]
        pairs.append(ContactPair(("box", "table"), (materials[1], "table")))
    scene = _scene(spec, pairs)
    scene.ears = {"left_finger": np.array([0, 0.03, 0.06]), "right_finger": np.array([0, -0.03, 0.06])}
    scene.data.qpos[:2] = 0.0275
    if box:
        scene.data.qpos[4] -= 1e-4
    scene.data.ctrl[:] = -0.05
    return scene


def listen(
    scene: Scene, steps: list[Contacts], synth: Synthesizer | None = None, seed: int = 0,
    finger_speed: float | list[np.ndarray] = 0.0, bending: dict[str, Bending] | None = None,
) -> dict[str, np.ndarray]:  # fmt: skip
    """What each microphone hears of some control steps, int16; the fingers' speed [m/s] is one, or of every physics step."""
    synth = synth or scene.synth()
    synth.reset(np.random.default_rng(seed))
    still = np.zeros(scene.n_substeps)
    if isinstance(finger_speed, float):
        finger_speed = [still + finger_speed] * len(steps)
    blocks = [
        synth.step(contacts, still, fingers, scene.ears, bending)
        for contacts, fingers in zip(steps, finger_speed, strict=True)
    ]
    return {ear: np.concatenate([block[ear] for block in blocks]) for ear in scene.ears}


def level(samples: np.ndarray) -> float:
    """[dBFS], rms."""
    return float(20 * np.log10(np.sqrt(np.mean((samples / 32768.0) ** 2)) + 1e-9))


def centroid(samples: np.ndarray, sample_rate: int = 16000) -> float:
    """Centre of the power spectrum [Hz]."""
    power = np.abs(np.fft.rfft(samples / 32768.0)) ** 2
    return float(np.fft.rfftfreq(len(samples), 1 / sample_rate) @ power / max(power.sum(), 1e-20))


def _spec(timestep: float) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.option.timestep = timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10
    return spec


def _table(spec: mujoco.MjSpec, softness: float) -> None:
    table = spec.worldbody.add_body(name="table")
    table.add_geom(type=_PLANE, size=[2, 2, 0.1], friction=[0.4, 0.005, 0.0001], solref=[softness, 1])


def _scene(spec: mujoco.MjSpec, pairs: list[ContactPair]) -> Scene:
    add_sensors(spec, pairs)
    return Scene(spec.compile(), pairs)
