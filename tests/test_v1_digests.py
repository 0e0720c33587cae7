"""Version 1 of the tasks gives the bytes that it always gave: what the policy's camera shows, what is heard, and the rest.

A change of physics, of the sound or of the expert changes these digests, and then results stop being comparable: it wants a
reason in the change log, and new digests. How people see the scene is not in them (`tests/test_visuals.py`).

Where the last bits of linear algebra or of the physics differ, an episode takes another course, and renderers differ in pixels.
Digests therefore belong to a kind of machine, which two probes tell; on another kind the test says so and is skipped.
`python tests/test_v1_digests.py` prints what to add: run it on a commit that is known to be right.
"""

import hashlib
import json
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest

DIGESTS = Path(__file__).parent / "v1_digests.json"
TASKS = ("OccludedGrasp-v1", "OccludedPickPlace-v1", "TellApart-v1", "KeyBag-Easy-v1", "KeyBag-Hard-v1")

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


def digests(task: str, **options) -> dict[str, str]:
    """Of one seeded episode by the expert, after some random actions."""
    env = gym.make(f"gym_playbyear:gym_playbyear/{task}", disable_env_checker=True, **options)
    kinds = {"pictures": hashlib.sha256(), "sound": hashlib.sha256(), "numbers": hashlib.sha256()}
    rng = np.random.default_rng(5)

    def note(observation, *outcome) -> bool:
        for name, value in arrays(observation):
            kind = "pictures" if "pixels" in name else "sound" if "audio" in name else "numbers"
            kinds[kind].update(f"{name} {value.dtype} {value.shape}".encode() + value.tobytes())
        kinds["numbers"].update(repr([float(value) for value in outcome[:3]]).encode())
        return bool(outcome) and (outcome[1] or outcome[2])

    note(env.reset(seed=11)[0])
    for _ in range(3):
        note(*env.step(np.append(rng.uniform(-0.2, 0.2, 3), -1.0)))
    expert = env.unwrapped.scripted_expert()
    while not note(*env.step(expert.act())):
        pass
    env.close()
    # What pictures show is what the arithmetic of the physics made of the episode: in a bag of many contacts it differs.
    probes = {"pictures": f"{look()}, {arithmetic()}", "sound": arithmetic(), "numbers": arithmetic()}
    return {f"{kind}, {probes[kind]}": digest.hexdigest()[:16] for kind, digest in kinds.items()}


@pytest.mark.parametrize("task", TASKS)
def test_an_episode_is_the_one_it_always_was(task):
    known = json.loads(DIGESTS.read_text())[task]
    if f"numbers, {arithmetic()}" not in known:
        pytest.skip(f"{DIGESTS.name} has no digests for this machine ({arithmetic()})")
    seen = digests(task)
    assert seen == {probe: known.get(probe, digest) for probe, digest in seen.items()}


if __name__ == "__main__":
    print(json.dumps({task: digests(task) for task in TASKS}, indent=1))
