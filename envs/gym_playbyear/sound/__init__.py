"""The sound of contact: what microphones hear of what touches.

In a MuJoCo model of your own, `spec` a `mujoco.MjSpec`:

    pairs = [
        ContactPair(("left_finger", "cube"), ("gripper", "cube")),  # bodies of the model, and their materials
        ContactPair(("right_finger", "cube"), ("gripper", "cube")),  # one pair a finger: in one, a squeeze's forces cancel
        ContactPair(("link5", "table"), ("gripper", "table"), subtrees=(True, False)),
        ContactPair(("left_finger", "right_finger"), ("gripper", "gripper"), stop="left_finger"),  # a joint's lower limit
    ]
    add_sensors(spec, pairs)
    model = spec.compile()
    reader = ContactReader(model, pairs)
    synthesizer = Synthesizer(pairs, ("left_finger", "right_finger"), 16000, control_hz=20, physics_dt=0.002)
    synthesizer.reset(rng)
    # for every control step, from mujoco.rollout's sensordata (physics steps, numbers):
    blocks = synthesizer.step(reader.read(sensordata), joint_speed, finger_speed, {"left_finger": place, "right_finger": place})

`ContactPair`, `ContactReader` and `add_sensors` are in `gym_playbyear.contacts`. What crackles is told how it bends:
`bending={"bag": Bending(speed, position)}`.
"""

from gym_playbyear.sound.excitation import Bending
from gym_playbyear.sound.microphones import ALL_MICROPHONES
from gym_playbyear.sound.synthesizer import BACKGROUND_RMS, Synthesizer

__all__ = ["ALL_MICROPHONES", "BACKGROUND_RMS", "Bending", "Synthesizer"]
