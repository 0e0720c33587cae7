"""Version 0 of the tasks gives the bytes that it always gave: old results stay what they were.

Where the last bits of linear algebra or of the physics differ, an episode takes another course, and renderers differ in pixels.
Digests therefore belong to a kind of machine, which two probes tell; on another kind the test says so and is skipped.
`python tests/test_v0_digests.py` prints what to add: run it on a commit that is known to be right.
"""

import hashlib
import json
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest

DIGESTS = Path(__file__).parent / "v0_digests.json"
TASKS = ("OccludedGrasp-v0", "OccludedPickPlace-v0")
CASES = [
    *((task, variant, "waveform") for task in TASKS for variant in ("default", "paper")),
    *((task, "default", "contact_force") for task in TASKS),
]
_FALL = """<mujoco><worldbody><geom type="plane" size="1 1 1"/><body pos="0 0 .2" euler="10 20 30"><freejoint/>
<geom type="box" size=".05 .05 .05"/></body></worldbody></mujoco>"""


def arithmetic() -> str:
    """A probe of this machine's linear algebra and physics, without any of our code."""
    digest, rng = hashlib.sha256(mujoco.mj_versionString().encode()), np.random.default_rng(0)
    for _ in range(20):
        matrix, vector = rng.standard_normal((6, 6)), rng.standard_normal(6)
        digest.update(np.linalg.solve(matrix @ matrix.T, vector).tobytes())
        digest.update((rng.standard_normal((25, 48), np.float32) @ rng.standard_normal((48, 32), np.float32)).tobytes())
        digest.update(np.exp(vector + 1j * vector).tobytes() + np.tanh(vector).tobytes())
    model = mujoco.MjModel.from_xml_string(_FALL)
    data = mujoco.MjData(model)
    for _ in range(300):
        mujoco.mj_step(model, data)
    digest.update(data.qpos.tobytes())
    return f"arithmetic {digest.hexdigest()[:16]}"


def look() -> str:
    """A probe of this machine's renderer."""
    model = mujoco.MjModel.from_xml_string(_FALL)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, 84, 84) as renderer:
        renderer.update_scene(data)
        picture = renderer.render()
    return f"renderer {hashlib.sha256(picture.tobytes()).hexdigest()[:16]}"


def arrays(observation: dict, name: str = ""):
    """Name and array of everything observed, in a fixed order."""
    for key, value in sorted(observation.items()):
        yield from arrays(value, key) if isinstance(value, dict) else [(f"{name}.{key}", value)]


def digests(task: str, variant: str, sound: str) -> dict[str, str]:
    """Of one seeded episode by the expert, after some random actions, and of another of random actions alone."""
    ears = {"microphones": ("gripper", "table")} if sound == "waveform" else {}
    env = gym.make(
        f"gym_playbyear:gym_playbyear/{task}", variant=variant, sound=sound, disable_env_checker=True, **ears
    )
    numbers, pictures, rng = hashlib.sha256(), hashlib.sha256(), np.random.default_rng(5)

    def note(observation, *outcome) -> bool:
        for name, value in arrays(observation):
            (pictures if "pixels" in name else numbers).update(
                f"{name} {value.dtype} {value.shape}".encode() + value.tobytes()
            )
        numbers.update(repr([float(value) for value in outcome[:3]]).encode())
        return bool(outcome) and (outcome[1] or outcome[2])

    note(env.reset(seed=11)[0])
    for _ in range(6):
        note(*env.step(np.append(rng.uniform(-0.3, 0.3, 3), -1.0)))
    expert = env.unwrapped.scripted_expert()
    while not note(*env.step(expert.act())):
        pass
    note(env.reset()[0])
    for _ in range(20):
        note(*env.step(rng.uniform(-1, 1, 4)))
    env.close()
    return {arithmetic(): numbers.hexdigest()[:16], look(): pictures.hexdigest()[:16]}


@pytest.mark.parametrize("case", CASES, ids="/".join)
def test_an_episode_is_the_one_it_always_was(case):
    known = json.loads(DIGESTS.read_text())["/".join(case)]
    if arithmetic() not in known:
        pytest.skip(f"{DIGESTS.name} has no digests for this machine ({arithmetic()})")
    of_machine = digests(*case)
    assert of_machine == {probe: known.get(probe, digest) for probe, digest in of_machine.items()}


if __name__ == "__main__":
    print(json.dumps({"/".join(case): digests(*case) for case in CASES}, indent=1))
