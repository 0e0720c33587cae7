"""A page of films to listen to: the expert in every task of version 1, with sound.

    python tools/listen_page.py --output=docs/media/listen

writes a film per task, `index.html`, in which a browser plays them, and `tasks.jpg`, a still of each; ten minutes on one core.
Left is what people see, right what the policy's camera sees, below the spectrogram of the gripper's microphone.
"""

import argparse
import html
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np
from PIL import Image

from lerobot_playbyear.film.video import compose, film_sound, write_film

_SIZE = 360  # pixels of a view's side
_FINER = 2  # the people's view is drawn so many times larger, so that its edges become smooth
_QUALITY = {"crf": "31", "preset": "slow"}
_STILL = 300  # pixels


class Scene(NamedTuple):
    """name: of the film. task, options: what is played. still: share of the episode at which its picture is taken."""

    name: str
    task: str
    options: dict
    still: float
    text: str


SCENES = (
    Scene(
        "occluded_grasp",
        "OccludedGrasp-v1",
        {},
        0.55,
        "The hand sweeps along behind the wall until it touches the cube, hops over it, grasps it and lifts it, all unseen.",
    ),
    Scene(
        "occluded_pick_place",
        "OccludedPickPlace-v1",
        {},
        0.75,
        "The same behind half a wall; the cube goes into the tray.",
    ),
    Scene(
        "tell_apart_screws",
        "TellApart-v1",
        {"contents": "screws"},
        0.35,
        "The pouch is lifted, dropped, and listened to: there are screws in it, so it is lifted again.",
    ),
    Scene(
        "tell_apart_peanuts",
        "TellApart-v1",
        {"contents": "peanuts"},
        0.9,
        "The same pouch with packing peanuts: it does not rattle, and is left.",
    ),
    Scene(
        "key_bag_easy",
        "KeyBag-Easy-v1",
        {},
        0.95,
        "Keys below a finger, at a depth that nobody sees: the hand goes down until it hears them, and around them.",
    ),
    Scene(
        "key_bag_hard",
        "KeyBag-Hard-v1",
        {"microphones": ("gripper",)},
        0.95,
        "Keys below one finger or the other: two microphones tell which (here one is heard). The crackle is the bag's.",
    ),
)


def film(scene: Scene, output: Path) -> np.ndarray:
    """Films the expert's first success, counting seeds from 0.

    Returns:
        The still, (H, W, 3) uint8.
    """
    env = gym.make(
        f"gym_playbyear:gym_playbyear/{scene.task}",
        render_mode="rgb_array",
        render_size=_FINER * _SIZE,
        disable_env_checker=True,
        **scene.options,
    ).unwrapped
    seed = next(seed for seed in range(20) if _solves(env, seed))
    observation, _ = env.reset(seed=seed)
    expert, done = env.scripted_expert(), False
    frames, blocks = [_frame(env, observation)], [observation["audio.gripper"]]
    while not done:
        observation, _, terminated, truncated, _ = env.step(expert.act())
        done = terminated or truncated
        frames.append(_frame(env, observation))
        blocks.append(observation["audio.gripper"])
    fps = env.control_hz
    env.close()
    sound, rate = film_sound([np.concatenate(blocks)], len(blocks), fps)
    pictures = compose(frames, len(frames), sound, rate)
    path = write_film(output / f"{scene.name}.mp4", pictures, fps, sound, rate, _QUALITY)
    print(f"{path}: seed {seed}, {len(frames) / fps:.0f} s, {path.stat().st_size / 1000:.0f} kB", flush=True)
    return frames[int(scene.still * (len(frames) - 1))][:, :_SIZE]


def _solves(env, seed: int) -> bool:
    env.reset_physics(seed=seed)
    expert, done, info = env.scripted_expert(), False, {}
    while not done:
        _, terminated, truncated, info = env.step_physics(expert.act())
        done = terminated or truncated
    return bool(info["is_success"])


def _frame(env, observation) -> np.ndarray:
    """People's view beside the policy's camera (size, 2 size, 3) uint8."""
    people = Image.fromarray(env.render()).resize((_SIZE, _SIZE), Image.Resampling.BOX)
    policy = Image.fromarray(observation["pixels"]["front"]).resize((_SIZE, _SIZE), Image.Resampling.NEAREST)
    return np.concatenate([np.asarray(people), np.asarray(policy)], axis=1)


def page() -> str:
    """The page that plays all films."""
    lines = [
        "<!doctype html><meta charset='utf-8'><title>Tasks that one has to hear</title>",
        "<style>body{font-family:sans-serif;max-width:760px;margin:2em auto}video{width:100%}</style>",
        "<h1>Tasks that one has to hear</h1>",
        "<p>The scripted expert, with sound: left what people see, right all that the policy's camera sees, below the "
        "spectrogram of the gripper's microphone. The sound is made as loud as it can be.</p>",
    ]
    for scene in SCENES:
        lines.append(f"<h2>{html.escape(scene.task)}</h2><p>{html.escape(scene.text)}</p>")
        lines.append(f"<video controls preload='metadata' src='{scene.name}.mp4'></video>")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("docs/media"))
    output = parser.parse_args().output
    output.mkdir(parents=True, exist_ok=True)
    stills = [film(scene, output) for scene in SCENES]
    shown = [
        Image.fromarray(stills[index]).resize((_STILL, _STILL), Image.Resampling.LANCZOS) for index in (0, 1, 2, 4)
    ]
    Image.fromarray(np.concatenate([np.asarray(still) for still in shown], axis=1)).save(
        output / "tasks.jpg", quality=88
    )
    (output / "index.html").write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
